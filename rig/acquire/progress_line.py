"""Progress line of a collection: rewritten in place on a terminal, else logged periodically.

It is not drawn by `recorder.progress`: the thread that moves the robot writes it, in about 2 us,
for which rich takes about 0.4 ms (500 redraws, 5 runs).
"""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Iterable
from typing import Any, TextIO

from recorder.progress import duration
from rig.acquire.streams import Streams
from rig.core.clock import SECOND_NS
from rig.core.paced_line import PacedLine
from trajectories import PHASES, Move, Target

logger = logging.getLogger(__name__)

_ON_TERMINAL_NS = SECOND_NS // 5
_IN_LOG_NS = 10 * SECOND_NS


class LiveLine:
    """Progress of a collection of `total` targets, of which this run presses those of `pressing`.

    The predicted duration of a target, `planned` [s], counts like one target that was measured, so
    that the remaining time is known from the beginning.
    """

    def __init__(
        self,
        streams: Streams,
        total: int,
        *,
        planned: float,
        pressing: Iterable[int] | None = None,
        out: TextIO | None = None,
    ) -> None:
        self._streams = streams
        self._total = total
        self._planned_ns = round(planned * SECOND_NS)
        self._clock = clock = streams.clock
        self._line = PacedLine(
            clock,
            out or sys.stdout,
            _ON_TERMINAL_NS,
            _IN_LOG_NS,
            functools.partial(logger.info, "%s"),
        )
        order = range(total) if pressing is None else pressing
        # Number of targets before a target, in this run.
        self._before = {index: number for number, index in enumerate(order)}
        # Beginning of the first target of this run and of the current one, moved by pauses.
        self._start_ns = self._target_ns = clock.now_ns()
        self._target: Target | None = None
        self._move: Move | None = None
        self._ended: dict[int, str] = {}
        self._waiting = ""

    def at(self, target: Target, move: Move | None) -> None:
        """Set the current target and move."""
        if self._target is None:
            self._start_ns = self._target_ns = self._clock.now_ns()
        elif target.index != self._target.index:
            self._target_ns = self._clock.now_ns()
        self._target, self._move = target, move

    def waiting(self, why: str) -> None:
        """Show why nothing moves in place of the phase; a new reason is shown immediately."""
        if why != self._waiting:
            self._waiting = why
            self._line.hurry()

    def waited(self, duration_ns: int) -> None:
        """Continue; exclude a pause of `duration_ns` from the remaining time."""
        self._waiting = ""
        self._line.hurry()
        self._start_ns += duration_ns
        self._target_ns += duration_ns

    def ended(self, target: Target, outcome: str) -> None:
        """Record the outcome of a target: done or limited."""
        self._ended[target.index] = outcome

    def progress(self) -> dict[str, Any]:
        """Return the monitoring page's data: `Snapshot` fields, `ended`, `waiting`; thread-safe."""
        target, move = self._target, self._move
        if target is None:
            return {"left": self._seconds_left(self._clock.now_ns())}
        return {
            "target": target.index,
            "phase": self._phase(move),
            "left": self._seconds_left(self._clock.now_ns()),
            "ended": dict(self._ended),
            "waiting": bool(self._waiting),
        }

    def tick(self) -> None:
        """Write the line if it is due."""
        if self._target is not None and self._line.is_due():
            self._line.show(self._text(self._target))

    def end(self) -> None:
        """End the line and leave it on the terminal."""
        self._line.end()

    def _text(self, target: Target) -> str:
        counters = self._streams.counters()
        dropped = sum(int(count["dropped"]) for count in counters.values())
        rates = "  ".join(f"{name} {count['rate_hz']:.0f} Hz" for name, count in counters.items())
        parts = [
            f"target {target.index + 1}/{self._total}",
            f"{self._phase(self._move):<10}",
            f"{1e3 * target.depth:.2f} mm",
            f"{duration(self._seconds_left(self._clock.now_ns()))} left",
            self._streams.pressing(),
            f"dropped {dropped}",
            rates,
        ]
        return "  ".join(part for part in parts if part)

    def _phase(self, move: Move | None) -> str:
        return self._waiting or (PHASES[move.phase] if move is not None else "to point")

    def _seconds_left(self, now_ns: int) -> float:
        """Return the remaining time [s], by the plan and the targets pressed in this run."""
        done = 0 if self._target is None else self._before[self._target.index]
        per_target_ns = (self._planned_ns + self._target_ns - self._start_ns) / (1 + done)
        begun_ns = 0 if self._target is None else now_ns - self._target_ns
        current_ns = max(per_target_ns - begun_ns, 0)
        return (current_ns + per_target_ns * (len(self._before) - done - 1)) / SECOND_NS
