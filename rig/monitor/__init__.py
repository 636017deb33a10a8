"""Forces of a sensor while it is touched, by a model that `learning` trained."""
