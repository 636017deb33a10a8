"""Rendered markers against ray casting and Blender, and images per second."""
