"""Ask the system for punctual wake-ups; say what was granted, since a laboratory PC may refuse."""

from __future__ import annotations

import ctypes
import gc
import os

from rig.core.clock import SECOND_NS

# Of the streams' processes.
RIG_PRIORITY = 50
# Of emulators: the devices they stand for wait for nobody.
DEVICE_PRIORITY = 60
# Of the camera's emulator, which draws for milliseconds on end: below all that must not wait.
CAMERA_PRIORITY = 40
# Of what solves a simulated World: busier than the camera, and late at the cost of accuracy.
SOLVER_PRIORITY = 30
_PR_SET_TIMERSLACK = 29
_TIMER_SLACK_NS = 1


def be_punctual(priority: int = RIG_PRIORITY) -> dict[str, bool]:
    """Real-time scheduling, no timer slack, no garbage collection, for this process.

    The default timer slack alone wakes every sleep 50 us late. Garbage collection is switched off
    because it would come when it likes; a `Sweeper` does it when it suits.

    Args:
        priority: Of SCHED_FIFO, 1 to 99.

    Returns:
        What was granted, by name; stored with every stream.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return {"sched_fifo": _fifo(priority), "timer_slack": _timer_slack(), "gc_off": True}


def _fifo(priority: int) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def _timer_slack() -> bool:
    try:
        return bool(ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, _TIMER_SLACK_NS, 0, 0, 0) == 0)
    except (OSError, AttributeError):
        return False


class Sweeper:
    """Garbage collection by hand: reading a page by HTTP or encoding a chunk leaves cycles behind.

    What was there at `be_punctual` is frozen and what survived an earlier sweep is not looked at
    again, so a sweep takes a fraction of a millisecond.

    Args:
        every: Between two sweeps [s].
    """

    def __init__(self, every: float = 5.0) -> None:
        self._every_ns = round(every * SECOND_NS)
        self._due_ns = 0

    def sweep(self, now_ns: int) -> bool:
        """Collect if it is time to; whether it was."""
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + self._every_ns
        gc.collect(1)
        return True
