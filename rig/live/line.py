"""The line to watch: the newest force, rewritten ten times a second on a terminal."""

from __future__ import annotations

from typing import TextIO

from rig.clock import SECOND_NS, Clock
from rig.live.predictor import Reading

_ON_TERMINAL_NS, _ELSEWHERE_NS = SECOND_NS // 10, SECOND_NS
_CLEAR = "\x1b[K"


class ForceLine:
    """Prints forces, no more often than can be read.

    Args:
        clock: Clock.
        out: Where to write.
    """

    def __init__(self, clock: Clock, out: TextIO) -> None:
        self._clock, self._out = clock, out
        self._terminal = out.isatty()
        self._due_ns = 0
        self._open = False

    def __call__(self, reading: Reading, latency: float) -> None:
        """Show a force and its latency [s], if it is time to."""
        now_ns = self._clock.now_ns()
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + (_ON_TERMINAL_NS if self._terminal else _ELSEWHERE_NS)
        x, y, z = reading.force
        text = (
            f"Fx {x:+6.2f}  Fy {y:+6.2f}  Fz {z:+7.2f} N  "
            f"{'contact' if reading.contact else '       '}  {1e3 * latency:5.1f} ms"
        )
        self._open = self._terminal
        self._out.write(f"\r{text}{_CLEAR}" if self._terminal else f"{text}\n")
        self._out.flush()

    def close(self) -> None:
        """Leave the last line standing; safe twice."""
        if self._open:
            self._out.write("\n")
            self._out.flush()
            self._open = False
