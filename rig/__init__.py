"""The bench: clock, drivers and their emulators, the collect loop, safety."""
