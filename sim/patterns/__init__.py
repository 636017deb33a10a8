"""Patterns of markers: data, the signed distance that rendering reads, pictures of them."""

from sim.patterns.distance import BAND, STEP, DistanceTexture, Markers, distance_texture
from sim.patterns.image import ImagePattern
from sim.patterns.layouts import hexagon, rings, rows, staggered, turned
from sim.patterns.named import HOMOGENEOUS, NAMES, SIMULATED, named
from sim.patterns.pattern import Pattern

__all__ = [
    "BAND",
    "HOMOGENEOUS",
    "NAMES",
    "SIMULATED",
    "STEP",
    "DistanceTexture",
    "ImagePattern",
    "Markers",
    "Pattern",
    "distance_texture",
    "hexagon",
    "named",
    "rings",
    "rows",
    "staggered",
    "turned",
]
