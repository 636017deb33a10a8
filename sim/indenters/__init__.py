"""Rigid indenters as signed distance functions: values on the host, tables on the device."""

from sim.indenters.drawn import DRAWN_MOST, drawn_name, indenter_of, is_indenter, number_of
from sim.indenters.indenter import Indenter
from sim.indenters.outline import Part
from sim.indenters.parts import assembled
from sim.indenters.shapes import (
    NAMES,
    bar,
    box,
    cone,
    extruded,
    flat_punch,
    from_stl,
    named,
    plane,
    rounded_cone,
    sphere,
    torus,
    tube,
)
from sim.indenters.solid import UNITS, UPS, Solid

__all__ = [
    "DRAWN_MOST",
    "NAMES",
    "UNITS",
    "UPS",
    "Indenter",
    "Part",
    "Solid",
    "assembled",
    "bar",
    "box",
    "cone",
    "drawn_name",
    "extruded",
    "flat_punch",
    "from_stl",
    "indenter_of",
    "is_indenter",
    "named",
    "number_of",
    "plane",
    "rounded_cone",
    "sphere",
    "torus",
    "tube",
]
