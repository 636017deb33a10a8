"""Inertia: the body's mass resists acceleration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from sim.effects.declaration import Memory, Snippet
from sim.errors import check_range


@dataclass(frozen=True, slots=True)
class Inertia:
    """Lumped mass, backward Euler in time: steady at any step, damping what it cannot resolve.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    STATE: ClassVar[tuple[Memory, ...]] = (
        Memory("predicted", "node", 3),
        Memory("inertia_rate", "environment", 1),
    )
    KERNELS: ClassVar[tuple[Snippet, ...]] = (
        Snippet("sim.fem.vectors", "residual_kernel", "inertia"),
    )
    LIMIT: ClassVar[str] = "scale -> 0: a massless body"

    scale: float = 1.0
    """Factor on `Body.density`, 0 to 1e6: 1 is the real mass, larger is mass scaling."""

    def __post_init__(self) -> None:
        check_range("inertia", "scale", self.scale, 0.0, 1e6)

    def weakened(self, share: float) -> Inertia:
        """The effect with `share` of its mass: as `share` -> 0 it does nothing."""
        return replace(self, scale=share * self.scale)
