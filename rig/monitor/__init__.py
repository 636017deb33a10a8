"""Live forces of a touched sensor, predicted by a model trained with `learning`."""
