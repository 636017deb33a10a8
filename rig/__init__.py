"""Acquisition on the tactile bench: clocks, drivers, emulators, the collection loop, safety."""
