"""Error against latency and size of force models."""
