"""Physical effects of a scene: one file each, compiled out of the kernels when off."""

from __future__ import annotations

from dataclasses import dataclass

from sim.effects.friction import Friction
from sim.effects.gravity import Gravity
from sim.effects.inertia import Inertia
from sim.effects.viscosity import Viscosity
from sim.errors import check_kind

__all__ = ["Effects", "Friction", "Gravity", "Inertia", "Viscosity"]


KINDS = {"friction": Friction, "viscosity": Viscosity, "inertia": Inertia, "gravity": Gravity}


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects beyond frictionless, quasi-static elasticity; None is off."""

    friction: Friction | None = None
    """Coulomb friction between indenter and skin."""
    viscosity: Viscosity | None = None
    """Relaxation of the material: force depends on speed, and is higher while loading."""
    inertia: Inertia | None = None
    """Mass: the body oscillates and waves propagate."""
    gravity: Gravity | None = None
    """Weight: the body sags."""

    def __post_init__(self) -> None:
        for name, kind in KINDS.items():
            allowed = f"{'an' if kind is Inertia else 'a'} {kind.__name__}"
            check_kind(f"effects.{name}", getattr(self, name), kind, allowed, optional=True)

    @property
    def key(self) -> tuple[str, ...]:
        """Names of the active effects in fixed order, used as key of the kernel cache."""
        return tuple(name for name in self.__slots__ if getattr(self, name) is not None)
