"""Simulator of a rigid indenter that is pressed and sheared into a bonded soft layer."""

from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import Indenter
from sim.layer import Layer
from sim.mpm import Mpm
from sim.result import Quality, Result
from sim.scene import (
    Body,
    Effects,
    Friction,
    Gravity,
    Inertia,
    Motion,
    Scene,
    Viscosity,
    from_target,
    press,
)
from sim.simulate import Plan, plan, plan_effects, simulate, simulate_many

__all__ = [
    "Body",
    "Effects",
    "Fem",
    "Friction",
    "Gravity",
    "Indenter",
    "Inertia",
    "Layer",
    "Motion",
    "Mpm",
    "Plan",
    "Quality",
    "Result",
    "Scene",
    "SceneError",
    "SimulationDiverged",
    "Viscosity",
    "from_target",
    "plan",
    "plan_effects",
    "press",
    "simulate",
    "simulate_many",
]
