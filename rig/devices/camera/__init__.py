"""Tactile images: OpenCV camera driver and an emulated network camera."""
