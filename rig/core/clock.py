"""Integer nanoseconds of the monotonic clock, and pacing against absolute deadlines.

Nothing else in `rig` uses the `time` module, so tests can substitute a clock of their own.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

SECOND_NS = 1_000_000_000


class Clock(Protocol):
    """Clock used by all code that waits or takes timestamps."""

    def now_ns(self) -> int:
        """Return nanoseconds since an arbitrary origin, never going backwards."""

    def sleep_until(self, deadline_ns: int) -> None:
        """Return at `deadline_ns`, or immediately if it has passed."""


class SystemClock:
    """`time.monotonic_ns`, the clock that V4L2 uses for buffer timestamps."""

    def now_ns(self) -> int:
        """Return nanoseconds of CLOCK_MONOTONIC (restarts at boot)."""
        return time.monotonic_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleep until `deadline_ns`; return immediately if it has passed."""
        wait_ns = deadline_ns - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / SECOND_NS)


class Pacer:
    """Ticks at `rate_hz` from a fixed origin; late ticks are counted and skipped, not caught up.

    The deadlines are origin + k / rate_hz in whole nanoseconds, so no drift accumulates. The last
    `behind` late ticks are not skipped, but follow each other without a wait.
    """

    def __init__(self, clock: Clock, rate_hz: float, behind: int = 0) -> None:
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: {rate_hz!r}; allowed: above 0 Hz")
        self._clock = clock
        self._rate_hz, self._behind = rate_hz, behind
        self._origin_ns = clock.now_ns()
        self._tick = 0
        self.missed = 0
        """Ticks whose time passed before `wait` was called for them."""
        self.late = 0
        """Those of them that the last `wait` skipped."""

    def deadline_ns(self, tick: int) -> int:
        """Return the time at which `tick` is due [ns]."""
        return self._origin_ns + round(tick * SECOND_NS / self._rate_hz)

    def wait(self) -> int:
        """Sleep until the next tick still ahead and return its deadline [ns]."""
        elapsed_ns = self._clock.now_ns() - self._origin_ns
        due = max(self._tick + 1, int(elapsed_ns * self._rate_hz // SECOND_NS) - self._behind)
        self.late = due - self._tick - 1
        self.missed += self.late
        self._tick = due
        deadline_ns = self.deadline_ns(due)
        self._clock.sleep_until(deadline_ns)
        return deadline_ns


@dataclass(frozen=True, slots=True)
class ClockAnchor:
    """Relates one run's monotonic times to UTC and identifies the boot they belong to."""

    t0_ns: int
    """Monotonic time of the anchor [ns]."""
    utc_ns: int
    """UTC at the same moment [ns since 1970]."""
    boot_id: str
    """Changes at every boot: monotonic times of two boots must not be compared."""

    @classmethod
    def take(cls) -> Self:
        """Read UTC between two monotonic readings and keep the midpoint of the two."""
        before_ns = time.monotonic_ns()
        utc_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        boot = Path("/proc/sys/kernel/random/boot_id")
        boot_id = boot.read_text().strip() if boot.exists() else "unknown"
        return cls(t0_ns=(before_ns + after_ns) // 2, utc_ns=utc_ns, boot_id=boot_id)


def file_stamp() -> str:
    """Return the local date and time for a file name, such as 20260131-154500."""
    return time.strftime("%Y%m%d-%H%M%S")


def utc_text() -> str:
    """Return UTC to the minute, such as 2026-01-31 15:45 UTC."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
