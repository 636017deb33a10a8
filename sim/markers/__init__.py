"""From deformed surfaces to images of markers, and the displacement field that keeps them all."""

from __future__ import annotations

from sim.markers.camera import DISTANCE, FOCAL, HEIGHT, WIDTH, Camera
from sim.markers.image import ImagePattern
from sim.markers.pattern import (
    HOMOGENEOUS,
    NAMES,
    SIMULATED,
    Pattern,
    hexagon,
    named,
    rings,
    rows,
    staggered,
    turned,
)
from sim.markers.renderer import Renderer, View
from sim.markers.textures import (
    BAND,
    STEP,
    DistanceTexture,
    Markers,
    Textures,
    distance_texture,
    textures_of,
)

__all__ = [
    "BAND",
    "DISTANCE",
    "FOCAL",
    "HEIGHT",
    "HOMOGENEOUS",
    "NAMES",
    "SIMULATED",
    "STEP",
    "WIDTH",
    "Camera",
    "DistanceTexture",
    "ImagePattern",
    "Markers",
    "Pattern",
    "Renderer",
    "Textures",
    "View",
    "distance_texture",
    "hexagon",
    "named",
    "rings",
    "rows",
    "staggered",
    "textures_of",
    "turned",
]
