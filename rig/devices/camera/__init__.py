"""Tactile images: drivers of cameras and an emulated network camera."""
