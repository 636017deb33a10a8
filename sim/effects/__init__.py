"""Effects a scene may call for; each is one file, and absent from the kernels when it is off."""

from __future__ import annotations

from dataclasses import dataclass

from sim.effects.declaration import Memory, Snippet
from sim.effects.friction import Friction
from sim.effects.gravity import Gravity
from sim.effects.inertia import Inertia
from sim.effects.viscosity import Viscosity
from sim.errors import check_kind

__all__ = ["Effects", "Friction", "Gravity", "Inertia", "Memory", "Snippet", "Viscosity"]


KINDS = {"friction": Friction, "viscosity": Viscosity, "inertia": Inertia, "gravity": Gravity}


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

    def __post_init__(self) -> None:
        for name, kind in KINDS.items():
            allowed = f"{'an' if kind is Inertia else 'a'} {kind.__name__}"
            check_kind(f"effects.{name}", getattr(self, name), kind, allowed, optional=True)

    @property
    def key(self) -> tuple[str, ...]:
        """Names of the effects that are on, in fixed order; kernels are cached by them."""
        return tuple(name for name in self.__slots__ if getattr(self, name) is not None)
