"""The mock bench: the emulators of a bench's devices, and the World that they share."""
