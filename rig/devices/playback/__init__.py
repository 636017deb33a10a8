"""Emulated devices that play a recorded stream, one for each kind of device."""
