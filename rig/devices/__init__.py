"""Devices of a bench: of each kind a driver, its settings, and an emulator beside it."""
