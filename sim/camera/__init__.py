"""The camera below the gel: a pinhole that sees markers on the gel's top."""

from sim.camera.camera import DISTANCE, FOCAL, HEIGHT, WIDTH, Camera

__all__ = ["DISTANCE", "FOCAL", "HEIGHT", "WIDTH", "Camera"]
