"""Inertia: the body's mass resists acceleration."""

from __future__ import annotations

from dataclasses import dataclass

from sim.checks import check_range


@dataclass(frozen=True, slots=True)
class Inertia:
    """Lumped mass, backward Euler in time: steady at any step, damping what it cannot resolve.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    scale: float = 1.0
    """Factor on `Body.density`, 0 to 1e6: 1 is the real mass, larger is mass scaling."""

    def __post_init__(self) -> None:
        check_range("inertia", "scale", self.scale, 0.0, 1e6)
