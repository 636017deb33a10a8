"""A layer under an indenter whose tip goes where it is told, from pose to pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.indenters import Indenter
from sim.layer import Grid
from sim.layer.history import History
from sim.layer.solver import check_known
from sim.motion import Motion
from sim.scene import Scene
from sim.sensors import SimulatedSensor, SurfaceField
from sim.stream.carried import CarriedPress

Array = NDArray[np.floating[Any]]

GRID = 96
"""Pixels along the longer side: fewer than a `simulate` has, for half of its time."""
TOLERANCE = 1e-2
"""Residual of the contact: moves forces by some 1e-3, five times what a `simulate` allows."""
DEEPER = 2.0
"""How far it goes on pressing, in depths that the sensor is meant for: an arm may overshoot."""
RECOVERED = 0.1e-6
"""A dent that is left of a press counts as gone when it is shallower than this [m]."""


class LivePress:
    """The `layer` tier, pose by pose. Poses that it cannot reach are taken to its nearest ones.

    Args:
        sensor: What is pressed.
        indenter: With what.
        grid: Pixels along the body's longer side, 16 to 512.
        tolerance: Residual of the contact (`Contact.residual`), 1e-10 to 0.1.

    Raises:
        SceneError: A sensor or an effect that the tier does not know.
    """

    def __init__(
        self,
        sensor: SimulatedSensor,
        indenter: Indenter,
        *,
        grid: int = GRID,
        tolerance: float = TOLERANCE,
    ) -> None:
        body = sensor.body
        self._deepest = min(DEEPER * sensor.depth_max, 0.9 * body.thickness)
        self._thickness = body.thickness
        self._far = _beyond_reach(indenter, body.size_x, body.size_y)
        still = sensor.scene(indenter, Motion(tip=((0.0, 0.0, 0.0),), time=(0.0,)))
        self.scene = Scene(still.indenter, self._anywhere(), body=body, effects=still.effects)
        """The sensor and the indenter, in a motion that goes everywhere."""
        check_known(self.scene, tolerance)
        self._press = CarriedPress(self.scene, Grid(body, grid), tolerance)
        self._rests = True

    @property
    def grid(self) -> Grid:
        """The pixels of the top."""
        return self._press.grid

    @property
    def field(self) -> SurfaceField:
        """The displaced top, as a sensor reads it."""
        x, y = (np.asarray(axis, np.float64) for axis in (self.grid.x, self.grid.y))
        return SurfaceField(x, y, self.displacement[None])

    @property
    def tip(self) -> Array:
        """Where the tip is taken to be (3,) [m]."""
        return self._press.tip

    @property
    def touching(self) -> bool:
        """Whether anything is pressed."""
        return bool(self._press.traction[2].any())

    @property
    def wrench(self) -> Array:
        """Force and torque about the tip of the indenter on the body (6,) [N, N m]."""
        return self._press.wrench

    @property
    def shear(self) -> Array:
        """Mean sideways displacement of what is touched (2,) [m]; 0 where nothing is."""
        return self._press.shear

    @property
    def displacement(self) -> NDArray[np.float32]:
        """Of the top (X, Y, 3) [m]."""
        moved: NDArray[np.float32] = np.ascontiguousarray(
            np.moveaxis(self._press.displacement, 0, -1), np.float32
        )
        return moved

    def relaxing(self, within: float) -> Array:
        """Mean rate of the force (3,) [N/s] over the next `within` [s] if the tip stays there."""
        history = self._press.history
        after = history.after(within)
        traction = after.factor * history.elastic + after.held
        change: Array = (traction - self._press.traction).sum(axis=(1, 2))
        return change * (self.grid.area / within)

    def move(self, tip: Array, duration: float) -> None:
        """Bring the tip straight to `tip` (3,) [m] in `duration` [s].

        Raises:
            SceneError: A pose that is not finite, or a time below 0.
            SimulationDiverged: No contact was found; the press is as it was some steps before.
        """
        tip = np.asarray(tip, float)
        if tip.shape != (3,) or not np.isfinite(tip).all():
            raise SceneError(f"tip: {tip!r}; allowed: 3 finite numbers [m]")
        if not (np.isfinite(duration) and duration >= 0):
            raise SceneError(f"duration: {duration!r} s; allowed: 0 or more")
        tip = self._nearest(tip)
        if self._rests and tip[2] >= 0:
            self._press.tip = tip
            return
        self._press.move(tip, duration)
        self._rests = not self.touching and self._recovered()

    def _recovered(self) -> bool:
        """Whether there is no dent any more; what is less than one is forgotten."""
        press = self._press
        if np.abs(press.displacement).max() > RECOVERED:
            return False
        press.history = History(self.scene.effects.viscosity, self.grid.shape)
        press.displacement = np.zeros_like(press.displacement)
        return True

    def _nearest(self, tip: Array) -> Array:
        x, y = self._far
        near = np.clip(tip, [-x, -y, -self._deepest], [x, y, np.inf])
        if abs(tip[0]) >= x or abs(tip[1]) >= y:
            # Beside the body; as deep as ever there is nothing to touch.
            near[2] = max(near[2], 0.0)
        return near

    def _anywhere(self) -> Motion:
        # What is dragged along is looked for where it came from: a thickness away at most.
        (x, y), low = (far + self._thickness for far in self._far), -self._deepest
        corners = ((0.0, 0.0, 0.0), (x, y, low), (-x, -y, low))
        return Motion(tip=corners, time=(0.0, 1.0, 2.0))


def _beyond_reach(indenter: Indenter, size_x: float, size_y: float) -> tuple[float, float]:
    """How far aside of the body's middle the tip touches nothing, or a body's width [m]."""
    widths = [max(abs(side[0]), abs(side[1])) for side in indenter.bounds[:2]]
    x, y = (
        size / 2 + min(width, size) for size, width in zip((size_x, size_y), widths, strict=True)
    )
    return x, y
