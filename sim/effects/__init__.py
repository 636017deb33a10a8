"""Effects a scene may call for; each is one file, and absent from the kernels when it is off."""

from __future__ import annotations

from dataclasses import dataclass

from sim.effects.declaration import Memory, Snippet
from sim.effects.friction import Friction
from sim.effects.gravity import Gravity
from sim.effects.inertia import Inertia
from sim.effects.viscosity import Viscosity

__all__ = ["Effects", "Friction", "Gravity", "Inertia", "Memory", "Snippet", "Viscosity"]


@dataclass(frozen=True, slots=True)
class Effects:
    """What is simulated beyond frictionless, quasi-static elasticity. None is off."""

    friction: Friction | None = None
    """Coulomb friction between indenter and skin."""
    viscosity: Viscosity | None = None
    """Relaxation of the material: force depends on speed, loading lies above unloading."""
    inertia: Inertia | None = None
    """Mass: the body swings and waves travel."""
    gravity: Gravity | None = None
    """Weight: the body sags."""

    @property
    def key(self) -> tuple[str, ...]:
        """Names of the effects that are on, in fixed order; kernels are cached by them."""
        return tuple(name for name in self.__slots__ if getattr(self, name) is not None)
