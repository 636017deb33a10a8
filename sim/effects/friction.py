"""Coulomb friction: at every contact point the shear traction is at most mu times the pressure."""

from __future__ import annotations

from dataclasses import dataclass

from sim.checks import check_range


@dataclass(frozen=True, slots=True)
class Friction:
    """Coulomb friction with one coefficient for stick and slip.

    Raises:
        SceneError: A coefficient outside of 0 to 10.
    """

    coefficient: float
    """Shear traction over pressure at which a point slips, 0 to 10."""

    def __post_init__(self) -> None:
        check_range("friction", "coefficient", self.coefficient, 0.0, 10.0)
