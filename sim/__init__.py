"""Simulator of a rigid indenter that is pressed and sheared into a bonded soft layer.

A public name is imported when it is first used: a tier that is not needed is not imported.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.effect_sizes import EffectsTable, effects_table
    from sim.errors import SceneError, SimulationDiverged
    from sim.fem import Fem
    from sim.indenters import Indenter
    from sim.layer import Layer
    from sim.mpm import Mpm
    from sim.planning import Plan, plan
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
    from sim.tiers import simulate, simulate_many
    from sim.tolerance import replay

__all__ = [
    "Body",
    "Effects",
    "EffectsTable",
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
    "effects_table",
    "from_target",
    "plan",
    "press",
    "replay",
    "simulate",
    "simulate_many",
]

# Module of each name that is not in `scene`.
_MODULES = {
    "EffectsTable": "effect_sizes",
    "Fem": "fem",
    "Indenter": "indenters",
    "Layer": "layer",
    "Mpm": "mpm",
    "Plan": "planning",
    "Quality": "result",
    "Result": "result",
    "SceneError": "errors",
    "SimulationDiverged": "errors",
    "effects_table": "effect_sizes",
    "plan": "planning",
    "replay": "tolerance",
    "simulate": "tiers",
    "simulate_many": "tiers",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES.get(name, 'scene')}"), name)


def __dir__() -> list[str]:
    return __all__
