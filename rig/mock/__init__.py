"""The mock bench: emulators of a bench's devices, and their common World."""
