"""Rigid indenters as signed distance functions: a value on the host, a table on the device."""

from __future__ import annotations

from sim.indenters.indenter import Indenter
from sim.indenters.named import NAMES, named
from sim.indenters.part import Part
from sim.indenters.shapes import (
    bar,
    box,
    cone,
    extruded,
    flat_punch,
    plane,
    rounded_cone,
    sphere,
    torus,
    tube,
)

__all__ = [
    "NAMES",
    "Indenter",
    "Part",
    "bar",
    "box",
    "cone",
    "extruded",
    "flat_punch",
    "named",
    "plane",
    "rounded_cone",
    "sphere",
    "torus",
    "tube",
]
