"""Rendering of marker images from deformed surfaces.

`Renderer` and `Textures` import Warp, which readers of patterns and cameras do without.
"""

from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
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


def __getattr__(name: str) -> Any:
    if name not in ("Renderer", "Textures"):
        raise AttributeError(name)
    from sim.markers import renderer

    return getattr(renderer, name)
