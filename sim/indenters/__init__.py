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
from sim.indenters.solid import Solid
from sim.indenters.stl import from_stl
from sim.indenters.triangles import UNITS, UPS

__all__ = [
    "NAMES",
    "UNITS",
    "UPS",
    "Indenter",
    "Part",
    "Solid",
    "bar",
    "box",
    "cone",
    "extruded",
    "flat_punch",
    "from_stl",
    "named",
    "plane",
    "rounded_cone",
    "sphere",
    "torus",
    "tube",
]
