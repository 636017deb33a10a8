"""What a sensor's values do when the tip goes on, learned from the moves that it made."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

SURE = 20e-6
"""A move this long is believed by half [m]: the shorter it is, the more of what it changed is the
tolerance of the solutions and the grain of the grid."""


class Slope:
    """d values / d tip (n, 3), corrected along each move and kept across it.

    Broyden's update (Math. Comp. 19 (1965) 577), damped: of all matrices that give what the last
    move gave, the one nearest to that before; short moves are believed less. A contact that is
    pressed and then sheared keeps its stiffness to pressing while it learns that to shear, and a
    move back finds the stiffness of the way there.

    Args:
        count: Of the values.
    """

    def __init__(self, count: int) -> None:
        self.matrix: Array = np.zeros((count, 3))
        """(n, 3), in units of the values a metre."""

    def learn(self, moved: Array, changed: Array) -> None:
        """A move of the tip by `moved` (3,) [m] changed the values by `changed` (n,)."""
        missed = changed - self.matrix @ moved
        share = moved / (float(moved @ moved) + SURE**2)
        self.matrix = self.matrix + np.outer(missed, share)
