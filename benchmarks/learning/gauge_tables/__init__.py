"""Forces on a target without a gauge, beside the gauge presses that each method needs."""
