"""Coulomb friction: at every contact point, shear traction is at most mu times the pressure."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sim.errors import check_range


@dataclass(frozen=True, slots=True)
class Friction:
    """Coulomb friction with one coefficient for stick and slip.

    Raises:
        SceneError: The coefficient is not within 0 to 10.
    """

    coefficient: float
    """Ratio of shear traction to pressure at which a point slips, 0 to 10."""

    def __post_init__(self) -> None:
        check_range("friction", "coefficient", self.coefficient, 0.0, 10.0)

    def weakened(self, fraction: float) -> Friction:
        """Return the effect with its coefficient scaled by `fraction`; at 0 it vanishes."""
        return replace(self, coefficient=fraction * self.coefficient)
