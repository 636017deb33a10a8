"""From deformed surfaces to images of markers, and the displacement field that keeps them all."""

from sim.render.renderer import Renderer
from sim.render.textures import Textures, textures_of
from sim.render.view import View

__all__ = [
    "Renderer",
    "Textures",
    "View",
    "textures_of",
]
