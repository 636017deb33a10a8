"""Live views: forces predicted by a model as a sensor is touched, and `page` of a collection."""
