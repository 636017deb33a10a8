"""Inertia: the body's mass resists acceleration."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sim.errors import check_range


@dataclass(frozen=True, slots=True)
class Inertia:
    """Lumped mass with backward Euler: stable at any time step, damps motion it cannot resolve.

    Raises:
        SceneError: A value is out of range.
    """

    scale: float = 1.0
    """Factor on `Body.density`, 0 to 1e6: 1 is the real mass, larger is mass scaling."""

    def __post_init__(self) -> None:
        check_range("inertia", "scale", self.scale, 0.0, 1e6)

    def weakened(self, fraction: float) -> Inertia:
        """Return the effect with its mass scaled by `fraction`; at 0 it vanishes."""
        return replace(self, scale=fraction * self.scale)
