"""A live sensor: a press and what is measured of it, with what it takes to answer in between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.indenters import Indenter
from sim.sensors import SimulatedSensor, TaxelPad, TaxelSignal
from sim.stream.press import GRID, TOLERANCE, LivePress
from sim.stream.slope import Slope

Array = NDArray[np.floating[Any]]

WITHIN = 20e-3
"""Time over which relaxation is foretold [s]: about that from one solution to the next."""
LIGHT = ((0.0, 0.0, -0.05), (0.025, 0.0, -0.05), (0.025, 0.025, -0.05))
"""Tips of a press that tries the sensor out, in depths that it is meant for."""
COUNTS = 48
"""Counts of a pad: 16 taxels, 3 axes."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """The last solution, and how to go on from it while the next one is made.

    Values are the wrench about the tip (6,) [N, N m], then the raw counts (48,) of a pad of taxels,
    0 without one. For a tip near `tip`, `seconds` later:

        values + slope (x - tip) + rate seconds    where `touching`
        values + slope (0, 0, min(z, 0))           where it did not touch yet
    """

    tip: Array
    """(3,) [m]."""
    touching: bool
    values: Array
    """(54,)."""
    slope: Array
    """(54, 3) [1/m]; of the contact before, as long as nothing is touched."""
    rate: Array
    """(54,) [1/s]: what relaxes while the tip stays."""


class LiveSensor:
    """A sensor that is told where the indenter's tip is.

    Arguments and errors as `LivePress`.
    """

    def __init__(
        self,
        sensor: SimulatedSensor,
        indenter: Indenter,
        *,
        grid: int = GRID,
        tolerance: float = TOLERANCE,
    ) -> None:
        signal = sensor.signal
        self._pad = TaxelPad(sensor.body, signal) if isinstance(signal, TaxelSignal) else None
        self._slope = Slope(6 + COUNTS)
        # The first contact is foretold from a light one that is then forgotten.
        self.press = LivePress(sensor, indenter, grid=grid, tolerance=tolerance)
        self.answer = self._untouched()
        """The newest."""
        for x, y, z in LIGHT:
            self.move(sensor.depth_max * np.array([x, y, z]), 0.0)
        self.press = LivePress(sensor, indenter, grid=grid, tolerance=tolerance)
        self.answer = self._untouched()

    def move(self, tip: Array, duration: float) -> None:
        """Bring the tip to `tip` (3,) [m] in `duration` [s]; errors as `LivePress.move`."""
        before, press = self.answer, self.press
        press.move(tip, duration)
        values, rate = self._values(), np.zeros(6 + COUNTS)
        if press.touching:
            way = press.tip - (before.tip if before.touching else _touched(before.tip, press.tip))
            self._slope.learn(way, values - before.values - duration * before.rate)
            rate[:3] = press.relaxing(WITHIN)
        self.answer = Answer(press.tip, press.touching, values, self._slope.matrix, rate)

    def _untouched(self) -> Answer:
        return Answer(
            self.press.tip,
            touching=False,
            values=self._values(),
            slope=self._slope.matrix,
            rate=np.zeros(6 + COUNTS),
        )

    def _values(self) -> Array:
        press, values = self.press, np.zeros(6 + COUNTS)
        values[:6] = press.wrench
        if self._pad is not None:
            values[6:] = self._pad.raw(press.field)[0].ravel()
        return values


def _touched(before: Array, now: Array) -> Array:
    """Where on the way the tip went through the untouched surface (3,) [m]."""
    if before[2] <= 0 or now[2] >= 0:
        return before
    place: Array = before + (now - before) * (before[2] / (before[2] - now[2]))
    return place
