"""Request real-time scheduling and report the settings granted; a laboratory PC may refuse."""

import ctypes
import gc
import os

from rig.core.clock import SECOND_NS

# Stream processes.
RIG_PRIORITY = 50
# The process that moves the arm. ur_rtde waits for an answer without sleeping, some milliseconds a
# command: above the streams, it would cost frames of a camera where cores are few. Its thread that
# receives the answer comes one before.
ARM_PRIORITY = 35
# Emulators: the devices that they replace run regardless of the host's load.
DEVICE_PRIORITY = 60
# Camera emulator, which draws for milliseconds at a time: below every process that must not wait.
CAMERA_PRIORITY = 40
# Solver of a simulated World: busier than the camera; running late only costs accuracy.
SOLVER_PRIORITY = 30
# Live forces of a sensor: below all that is recorded.
LIVE_PRIORITY = 20
_PR_SET_TIMERSLACK = 29
_TIMER_SLACK_NS = 1


def enable_realtime(priority: int = RIG_PRIORITY) -> dict[str, bool]:
    """Enable real-time scheduling and disable timer slack and garbage collection in this process.

    The default timer slack alone delays every wake-up by 50 us. Garbage collection is disabled
    because its timing is unpredictable; a `Sweeper` runs it at suitable times. The priority is that
    of SCHED_FIFO, 1 to 99. Returns the settings granted, by name; stored with every stream.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return {"sched_fifo": take_priority(priority), "timer_slack": _timer_slack(), "gc_off": True}


def take_priority(priority: int) -> bool:
    """Run this thread, and those it starts, at a priority of 1 to 99; return True if granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def may_have_priority() -> bool:
    """Return True if real-time priority is granted; this process stays as it was."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        if not take_priority(RIG_PRIORITY):
            return False
        os.sched_setscheduler(0, *before)
    except (OSError, AttributeError):
        return False
    return True


def _timer_slack() -> bool:
    try:
        return bool(ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, _TIMER_SLACK_NS, 0, 0, 0) == 0)
    except (OSError, AttributeError):
        return False


class Sweeper:
    """Explicit garbage collection, for the cycles left by HTTP requests and chunk encoding.

    Objects from before `enable_realtime` are frozen and survivors of earlier sweeps are skipped, so
    a sweep, one in `every` [s], takes a fraction of a millisecond.
    """

    def __init__(self, every: float = 5.0) -> None:
        self._every_ns = round(every * SECOND_NS)
        self._due_ns = 0

    def sweep(self, now_ns: int) -> bool:
        """Collect if a sweep is due; return True if it was."""
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + self._every_ns
        gc.collect(1)
        return True
