"""Displacement of the surface around a contact: smooth closed forms, plausible, not a solution.

The mock bench needs markers that move with the contact, not a stress analysis: that is `sim`. The
shapes follow the kinematic marker models of the field (a dilation and a shear term, each decaying
away from the contact), with the decay lengths of a bonded layer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_DILATION = 0.35
# Outward motion at the edge of the contact, per depth: between 0.09 mm and 0.18 mm around a sphere
# pressed 1.4 mm over most of the layer in converged runs, more at the edge of a flat punch.


@dataclass(frozen=True, slots=True)
class Surface:
    """The state of the surface under one round contact, in the contact frame."""

    centre: tuple[float, float]
    """Middle of the contact [m]."""
    depth: float
    """Indentation [m], 0 when nothing touches."""
    radius: float
    """Radius of the contact [m]."""
    thickness: float
    """Thickness of the layer: the length over which everything decays [m]."""
    shear: tuple[float, float]
    """Sideways displacement of the surface in the contact [m]."""

    def displacement(self, points: np.ndarray) -> np.ndarray:
        """Where material points of the surface went.

        Args:
            points: Untouched positions (n, 2) in the contact frame [m].

        Returns:
            Displacement (n, 3) [m]; z is negative under the indenter.
        """
        moved = np.zeros((len(points), 3))
        if self.depth <= 0:
            return moved
        # The material under the tip now is what the shear has dragged there.
        home = np.array(self.centre) - np.array(self.shear)
        offset = points - home
        distance = np.hypot(offset[:, 0], offset[:, 1])
        outside = np.maximum(distance - self.radius, 0.0) / self.thickness
        moved[:, :2] = np.array(self.shear) * np.exp(-outside)[:, None]
        # Outward: linear inside the contact, largest at its edge, decaying over the thickness.
        reach = self.radius + 0.25 * self.thickness
        ratio = distance / reach
        dilation = _DILATION * self.depth * np.exp(0.5 * (1 - ratio**2)) / reach
        moved[:, :2] += offset * dilation[:, None]
        moved[:, 2] = -self.depth * np.exp(-2 * outside)
        return moved
