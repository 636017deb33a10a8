"""Measures the height of the surface and the latency of the camera, which bench files assume."""
