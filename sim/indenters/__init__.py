"""Rigid indenters as signed distance functions: values on the host, tables on the device."""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from sim.indenters.drawn import DRAWN_MOST as DRAWN_MOST
    from sim.indenters.drawn import drawn_name as drawn_name
    from sim.indenters.drawn import indenter_of as indenter_of
    from sim.indenters.drawn import is_indenter as is_indenter
    from sim.indenters.drawn import number_of as number_of
    from sim.indenters.indenter import Indenter as Indenter
    from sim.indenters.outline import Part as Part
    from sim.indenters.parts import assembled as assembled
    from sim.indenters.shapes import NAMES as NAMES
    from sim.indenters.shapes import bar as bar
    from sim.indenters.shapes import box as box
    from sim.indenters.shapes import cone as cone
    from sim.indenters.shapes import extruded as extruded
    from sim.indenters.shapes import flat_punch as flat_punch
    from sim.indenters.shapes import from_stl as from_stl
    from sim.indenters.shapes import named as named
    from sim.indenters.shapes import plane as plane
    from sim.indenters.shapes import rounded_cone as rounded_cone
    from sim.indenters.shapes import sphere as sphere
    from sim.indenters.shapes import torus as torus
    from sim.indenters.shapes import tube as tube
    from sim.indenters.solid import UNITS as UNITS
    from sim.indenters.solid import UPS as UPS
    from sim.indenters.solid import Solid as Solid

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
