"""Simulator of a rigid indenter that is pressed and sheared into a bonded soft layer."""

from sim.effects import Effects, Friction, Gravity, Inertia, Viscosity
from sim.errors import SceneError, SimulationDiverged
from sim.indenters import Indenter
from sim.result import Quality, Result
from sim.scene import Body, Motion, Scene, from_target, press, press_shear_return, ramp_hold
from sim.simulate import plan, simulate, simulate_many

__all__ = [
    "Body",
    "Effects",
    "Friction",
    "Gravity",
    "Indenter",
    "Inertia",
    "Motion",
    "Quality",
    "Result",
    "Scene",
    "SceneError",
    "SimulationDiverged",
    "Viscosity",
    "from_target",
    "plan",
    "press",
    "press_shear_return",
    "ramp_hold",
    "simulate",
    "simulate_many",
]
