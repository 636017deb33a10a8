"""Strict YAML into frozen values, as `recorder.settings` reads them.

Fields of this package carry their unit in their metadata; those of the rest of `sim`, which are in
SI, have theirs in `UNITS`.
"""

from __future__ import annotations

from collections.abc import Mapping

from recorder.settings import Reader
from sim.effects import Viscosity
from sim.errors import SceneError
from sim.markers import Pattern
from sim.scene import Body

UNITS: Mapping[type, Mapping[str, str]] = {
    Body: {
        "size_x": "mm",
        "size_y": "mm",
        "thickness": "mm",
        "dome_radius": "mm",
        "modulus": "kpa",
    },
    Viscosity: {"times": "s"},
    Pattern: {"size": "mm", "places": "mm", "angle": "deg"},
}

READER = Reader(SceneError, UNITS)
