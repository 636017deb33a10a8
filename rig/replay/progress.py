"""How far a replay has come: when a run has ended, and when it never will."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np

from rig.clock import SECOND_NS, Clock
from rig.collect.live import minutes
from rig.errors import DeviceLost
from rig.replay.cue import ENDED

logger = logging.getLogger(__name__)

MISSING_TIMEOUT = 5.0
"""After its emulator has sent all, a stream may take so long to have all rows [s]."""
STALL_TIMEOUT = 30.0
"""With rows left to send, nothing may happen for so long on top of the longest recorded gap [s]."""
_SAY_NS = 2 * SECOND_NS


class EndOfTape:
    """Judges, from time to time, whether every stream has every row.

    Args:
        totals: Rows of the run, by stream.
        gap: Longest time in which the tape itself holds no row [s].
    """

    def __init__(self, totals: Mapping[str, int], gap: float) -> None:
        self._totals = dict(totals)
        self._gap = gap
        self._seen: dict[str, tuple[int, int]] = {}
        self._changed_ns: dict[str, int] = {}

    def reached(
        self, now_ns: int, taken: Mapping[str, int], positions: Mapping[str, np.void | None]
    ) -> bool:
        """Whether all rows of all streams have been taken.

        Args:
            now_ns: The time [ns].
            taken: Rows taken by each stream's process.
            positions: POSITION of each emulator.

        Raises:
            DeviceLost: A stream has more rows than the tape, or will never have all: names the
                stream and how many rows are missing.
        """
        for name, total in self._totals.items():
            if taken[name] > total:
                raise DeviceLost(f"{name}: {taken[name] - total} rows more than were sent")
        if all(taken[name] == total for name, total in self._totals.items()):
            return True
        moving = False
        for name in self._totals:
            position = positions[name]
            sent = 0 if position is None else int(position["sent"])
            if self._seen.get(name) != (sent, taken[name]) or name not in self._changed_ns:
                self._seen[name] = (sent, taken[name])
                self._changed_ns[name] = now_ns
                moving = True
        for name, total in self._totals.items():
            position = positions[name]
            still = (now_ns - self._changed_ns[name]) / SECOND_NS
            ended = position is not None and position["state"] == ENDED
            missing = total - taken[name]
            if missing and ended and still > MISSING_TIMEOUT:
                raise DeviceLost(
                    f"{name}: {missing} of {total} rows are missing {still:.0f} s after its "
                    "emulator had sent all"
                )
        stalled = (now_ns - max(self._changed_ns.values())) / SECOND_NS
        if not moving and stalled > STALL_TIMEOUT + self._gap:
            left = {name: total - taken[name] for name, total in self._totals.items()}
            raise DeviceLost(f"replay: nothing happens for {stalled:.0f} s; rows missing: {left}")
        return False


class ReadingProgress:
    """Says every other second how far reading of images has come.

    Args:
        what: The word for it.
        clock: Clock.
    """

    def __init__(self, what: str, clock: Clock) -> None:
        self._what = what
        self._clock = clock
        self._start_ns = clock.now_ns()
        self._due_ns = self._start_ns + _SAY_NS

    def __call__(self, done: int, total: int) -> None:
        """Say that `done` of `total` images are read, when it is time to."""
        now_ns = self._clock.now_ns()
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + _SAY_NS
        left = (now_ns - self._start_ns) / SECOND_NS * (total - done) / done
        logger.info("%s: image %d of %d, %s left", self._what, done, total, minutes(left))
