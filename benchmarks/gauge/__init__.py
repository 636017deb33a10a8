"""Forces on a sensor without a gauge, from the weakest way to the strongest."""
