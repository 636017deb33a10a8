"""What is kept of a press at each waypoint: force, surface, and how far it can be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim.layer.press import Press, Spent
from sim.result import Quality, Result
from sim.scene import Scene


class Frames:
    """Frames of one press, filled one after the other.

    `balance` stays NaN: base and top are in balance wave by wave, there is nothing to compare.
    """

    def __init__(self, scene: Scene, press: Press) -> None:
        """Make room for a frame at each waypoint."""
        self._scene, self._press = scene, press
        count = len(scene.motion)
        self._wrench = np.zeros((count, 6))
        self._surface = np.zeros((count, *press.grid.shape, 3), np.float32)
        self._traction = np.zeros((count, *press.grid.shape, 3), np.float32)
        self._quality = {
            name: np.full(count, np.nan)
            for name in ("residual", "contact", "balance", "energy_gap", "det_f_min", "slip_excess")
        }
        self._newton, self._steps = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._start: tuple[float, float] | None = None
        self._work_most = 0.0

    def keep(self, frame: int) -> None:
        """Keep the press as it is now."""
        press, quality = self._press, self._quality
        self._surface[frame] = np.moveaxis(press.displacement, 0, -1)
        self._traction[frame] = np.moveaxis(press.traction, 0, -1)
        self._wrench[frame] = press.wrench
        quality["residual"][frame] = press.residual
        overlap = max(0.0, -float(press.gap.min()))
        quality["contact"][frame] = overlap / -press.tip[2] if press.tip[2] < 0 else 0.0
        quality["energy_gap"][frame] = self._lost()
        quality["slip_excess"][frame] = press.slip_excess
        self._newton[frame], self._steps[frame] = press.spent.iterations, press.spent.steps
        press.spent = Spent()

    def _lost(self) -> float:
        energy, work = self._press.energy, self._press.work
        if self._start is None:
            self._start = energy, work
        stored, done = energy - self._start[0], work - self._start[1]
        self._work_most = max(self._work_most, done)
        return (done - stored) / self._work_most if self._work_most > 0 else 0.0

    def result(self, record: dict[str, Any]) -> Result:
        """The result, once every frame was kept."""
        grid = self._press.grid
        return Result(
            scene=self._scene,
            tier="layer",
            wrench=self._wrench,
            surface_x=grid.x.astype(np.float64),
            surface_y=grid.y.astype(np.float64),
            surface=self._surface,
            traction=self._traction,
            quality=Quality(
                **self._quality,
                newton=self._newton,
                cg=np.zeros_like(self._newton),
                steps=self._steps,
            ),
            record=record,
        )
