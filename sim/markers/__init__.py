"""Rendering of marker images from deformed surfaces."""

from __future__ import annotations

from sim.markers.camera import DISTANCE, FILM, FOCAL, HEIGHT, LENS, WIDTH, Camera
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
from sim.markers.renderer import SPACING, Renderer, View
from sim.markers.textures import (
    BAND,
    STEP,
    Textures,
)
from sim.markers.top import cubic_taps, top_of

__all__ = [
    "BAND",
    "DISTANCE",
    "FILM",
    "FOCAL",
    "HEIGHT",
    "HOMOGENEOUS",
    "LENS",
    "NAMES",
    "SIMULATED",
    "SPACING",
    "STEP",
    "WIDTH",
    "Camera",
    "Pattern",
    "Renderer",
    "Textures",
    "View",
    "cubic_taps",
    "hexagon",
    "named",
    "rings",
    "rows",
    "staggered",
    "top_of",
    "turned",
]
