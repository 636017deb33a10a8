"""Rendering of marker images from deformed surfaces."""

from sim.markers.camera import DISTANCE, FOCAL, HEIGHT, WIDTH, Camera
from sim.markers.pattern import (
    HOMOGENEOUS,
    NAMES,
    SIMULATED,
    Pattern,
    hexagon,
    named,
    rings,
    staggered,
)
from sim.markers.renderer import Renderer
from sim.markers.textures import Textures

__all__ = [
    "DISTANCE",
    "FOCAL",
    "HEIGHT",
    "HOMOGENEOUS",
    "NAMES",
    "SIMULATED",
    "WIDTH",
    "Camera",
    "Pattern",
    "Renderer",
    "Textures",
    "hexagon",
    "named",
    "rings",
    "staggered",
]
