"""Finite elements at large strain: the exact tier."""
