"""Progress line with the current measurement and the estimated remaining time."""

from __future__ import annotations

import sys
from typing import TextIO

from rig.acquire.progress_line import minutes
from rig.core.clock import SECOND_NS, Clock


class Progress:
    """Progress over all announced steps.

    Args:
        clock: Clock.
        total: Expected duration of all steps together [s].
        out: Output stream; the line is rewritten on a terminal, else every step gets its own line.
    """

    def __init__(self, clock: Clock, total: float, out: TextIO | None = None) -> None:
        self._clock = clock
        self._total = total
        self._out = sys.stderr if out is None else out
        self._start_ns = clock.now_ns()
        self._done = 0.0
        self._current = 0.0

    @property
    def left(self) -> float:
        """Expected time until the end [s], from the announced durations and the pace so far."""
        rest = max(self._total - self._done, 0.0)
        elapsed = (self._clock.now_ns() - self._start_ns) / SECOND_NS
        pace = elapsed / self._done if self._done > 0 else 1.0
        return rest * pace

    def step(self, title: str, seconds: float) -> None:
        """Begin a step that should take `seconds`; the previous step is done."""
        self._done += self._current
        self._current = seconds
        text = f"{title:<58}{minutes(self.left):>6} left"
        if self._out.isatty():
            self._out.write(f"\r{text:<79}")
        else:
            self._out.write(f"{text}\n")
        self._out.flush()

    def finish(self) -> None:
        """End the progress line."""
        if self._out.isatty():
            self._out.write("\n")
            self._out.flush()
