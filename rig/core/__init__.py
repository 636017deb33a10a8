"""What knows no device: time, shared memory, the guard, configuration, geometry, emulation."""
