"""Rendering of marker images from deformed surfaces.

`Renderer` and `Textures` import Warp, which readers of patterns and cameras do without.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from sim.markers.camera import DISTANCE as DISTANCE
    from sim.markers.camera import FOCAL as FOCAL
    from sim.markers.camera import HEIGHT as HEIGHT
    from sim.markers.camera import WIDTH as WIDTH
    from sim.markers.camera import Camera as Camera
    from sim.markers.pattern import HOMOGENEOUS as HOMOGENEOUS
    from sim.markers.pattern import NAMES as NAMES
    from sim.markers.pattern import SIMULATED as SIMULATED
    from sim.markers.pattern import Pattern as Pattern
    from sim.markers.pattern import hexagon as hexagon
    from sim.markers.pattern import named as named
    from sim.markers.pattern import rings as rings
    from sim.markers.pattern import staggered as staggered
    from sim.markers.renderer import Renderer as Renderer
    from sim.markers.textures import Textures as Textures

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
