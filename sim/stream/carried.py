"""A layer whose indenter keeps to the material that it has dragged along."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.indenters import Indenter
from sim.layer import Grid, Press
from sim.layer.clearance import Clearance
from sim.motion import Motion
from sim.scene import Scene

Array = NDArray[np.floating[Any]]


class Carried(Clearance):
    """The gap to an indenter above material that has moved aside by `drag` (2,) [m]."""

    def __init__(self, indenter: Indenter, grid: Grid, motion: Motion) -> None:
        super().__init__(indenter, grid, motion)
        self.drag: Array = np.zeros(2)

    def at(self, tip: Array) -> Array:
        """The gap at every pixel (nx, ny) with the tip at (3,) [m]."""
        return super().at(tip - np.array([*self.drag, 0.0]))


class CarriedPress(Press):
    """The `layer` tier's press with the sideways displacement of what is touched in its gaps.

    Small strains let the gap be taken above untouched material, so an indenter that drags its
    contact along leaves the pixels it sticks to, one row after the other, and its force jumps with
    each. Here the gap is taken above material displaced as what was touched last is on average: as
    long as it sticks, the pixels that it presses stay the same ones.
    """

    def __init__(self, scene: Scene, grid: Grid, tolerance: float) -> None:
        super().__init__(scene, grid, tolerance)
        self._carried = Carried(scene.indenter, grid, scene.motion)
        self._clearance = self._carried

    @property
    def shear(self) -> Array:
        """Mean sideways displacement of what is touched (2,) [m]; 0 where nothing is."""
        touched = self.traction[2] != 0
        if not touched.any():
            return np.zeros(2)
        moved: Array = self.displacement[:2, touched].mean(axis=1)
        return moved

    def move(self, tip: Array, duration: float) -> None:
        """Bring the tip straight to `tip` (3,) [m] in `duration` [s], as `Press.move`."""
        super().move(tip, duration)
        limit = self.grid.body.thickness
        self._carried.drag = np.clip(self.shear, -limit, limit)
