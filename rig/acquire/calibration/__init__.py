"""Measures what a bench file can only claim: where the surface is, how late the camera is."""
