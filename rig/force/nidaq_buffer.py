"""The inputs of an emulated task of an NI card, and the buffer its sample clock fills."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Channel:
    """One analog input of a task."""

    name: str
    number: int
    """Which gauge hangs on it."""
    low: float
    """Lower end of the range [V]."""
    high: float
    """Upper end [V]."""


class Buffer:
    """What the sample clock fills and a client empties."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.stopped = threading.Event()
        self._changed = threading.Condition()
        self._rows: list[Array] = []
        self.acquired = 0
        self.taken = 0
        self.overrun = False

    def put(self, rows: Array) -> None:
        """Add (n, channels); a client that is too late finds an error from then on."""
        with self._changed:
            self.acquired += len(rows)
            self.overrun = self.overrun or self.acquired - self.taken > self.capacity
            if not self.overrun:
                self._rows.append(rows)
            self._changed.notify_all()

    def take(self, count: int, timeout: float) -> Array | None:
        """The next (count, channels), fewer after `timeout` [s]; None after an overrun."""
        with self._changed:
            self._changed.wait_for(
                lambda: self.acquired - self.taken >= count or self.stopped.is_set(), timeout
            )
            if self.overrun:
                return None
            if not self._rows:
                return np.empty((0, 0))
            rows = np.concatenate(self._rows)
            self._rows = [rows[count:]] if len(rows) > count else []
            self.taken += len(rows[:count])
            return rows[:count]

    def stop(self) -> None:
        """End the clock that fills it."""
        self.stopped.set()
        with self._changed:
            self._changed.notify_all()
