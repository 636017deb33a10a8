"""Simulator of a rigid indenter that is pressed and sheared into a bonded soft layer.

A public name is imported when it is first used: a tier that is not needed is not imported.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from sim.effect_sizes import EffectsTable as EffectsTable
    from sim.effect_sizes import effects_table as effects_table
    from sim.errors import SceneError as SceneError
    from sim.errors import SimulationDiverged as SimulationDiverged
    from sim.fem import Fem as Fem
    from sim.indenters import Indenter as Indenter
    from sim.layer import Layer as Layer
    from sim.mpm import Mpm as Mpm
    from sim.planning import Plan as Plan
    from sim.planning import plan as plan
    from sim.result import Quality as Quality
    from sim.result import Result as Result
    from sim.scene import Body as Body
    from sim.scene import Effects as Effects
    from sim.scene import Friction as Friction
    from sim.scene import Gravity as Gravity
    from sim.scene import Inertia as Inertia
    from sim.scene import Motion as Motion
    from sim.scene import Scene as Scene
    from sim.scene import Viscosity as Viscosity
    from sim.scene import from_target as from_target
    from sim.scene import press as press
    from sim.tiers import simulate as simulate
    from sim.tiers import simulate_many as simulate_many
    from sim.tolerance import replay as replay

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
