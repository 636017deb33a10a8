"""The bench file: which devices at which addresses, which sensor, limits and plan."""
