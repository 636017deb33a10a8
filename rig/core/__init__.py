"""Device-independent parts: time, shared memory, guard, configuration, geometry, emulation."""
