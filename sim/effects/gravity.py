"""Gravity: the body's weight, and its initial sag."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sim.errors import SceneError, check_range


@dataclass(frozen=True, slots=True)
class Gravity:
    """Constant acceleration of the body's mass; the first frame is already in equilibrium with it.

    Raises:
        SceneError: A component is not within +-1000 m/s^2.
    """

    acceleration: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Acceleration in the contact frame [m/s^2]; +9.81 in z for a sensor that faces down."""

    def __post_init__(self) -> None:
        if not isinstance(self.acceleration, tuple | list) or len(self.acceleration) != 3:
            raise SceneError(f"gravity.acceleration: {self.acceleration!r}; allowed: 3 numbers")
        for index, value in enumerate(self.acceleration):
            check_range("gravity", f"acceleration[{index}]", value, -1e3, 1e3, unit="m/s^2")

    def weakened(self, fraction: float) -> Gravity:
        """Return the effect with its acceleration scaled by `fraction`; at 0 it vanishes."""
        x, y, z = self.acceleration
        return replace(self, acceleration=(fraction * x, fraction * y, fraction * z))
