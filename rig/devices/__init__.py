"""Devices of a bench: a driver, its settings and an emulator for each kind."""
