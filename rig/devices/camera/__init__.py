"""Tactile images: OpenCV cameras, their driver and an emulated network camera."""
