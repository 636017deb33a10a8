"""Taxels: the XELA uSkin server, its driver and its emulator."""
