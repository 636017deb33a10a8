"""Guards that stand in for a force gauge: the sensor's own signal, and the arm's own wrench.

Neither measures the force on the sensor. The signal is late and has no unit of force; the arm's
wrench is wrong by up to a third and by a few newtons. Each has its own limit, far below the
rating of the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rig.core.clock import SECOND_NS
from rig.core.guard import Mode, Violation
from rig.core.samples import FORCE_LATEST, SIGNAL_LATEST


def _stale(what: str, now_ns: int, t_ns: int, limit: float, cause: str) -> Violation | None:
    age = (now_ns - t_ns) / SECOND_NS
    if age <= limit:
        return None
    return Violation(
        "stale_force",
        f"{what} is {1e3 * age:.0f} ms old, allowed {1e3 * limit:.0f} ms: {cause}",
    )


@dataclass(frozen=True, slots=True)
class SignalGuard:
    """Stops the arm for what the sensor itself shows; in retreat, for nothing."""

    RECORD: ClassVar[np.dtype[Any]] = SIGNAL_LATEST

    largest: float
    """Largest motion of a marker [px] or deviation of a taxel [counts]."""
    stale: float
    """Longest time without a sample that differs from the one before [s]."""
    unit: str
    """`px` or `counts`."""
    contact: float = math.inf
    """Change, in standard deviations of the noise, that ends a press: for approaches."""

    def check(self, now_ns: int, records: np.ndarray | None, mode: Mode) -> Violation | None:
        """Return the reason to stop now, or None; see `rig.core.guard.Guard`."""
        if mode == "retreat":
            return None
        if records is None:
            return Violation("stale_force", "no signal of the sensor has arrived yet")
        fresh = _stale(
            "newest signal",
            now_ns,
            int(records["t_ns"][-1]),
            self.stale,
            "check the sensor and its cable",
        ) or _stale(
            "newest signal that changed",
            now_ns,
            int(records["fresh_ns"][-1]),
            self.stale,
            "the sensor repeats one picture or reading: is it frozen?",
        )
        if fresh is not None:
            return fresh
        what = "a marker moved" if self.unit == "px" else "a taxel changed"
        motion = float(records["motion"].max())
        # Negated, so that NaN stops too.
        if not motion <= self.largest:
            return Violation(
                "force_hard",
                f"signal: {what} by {motion:.3g} {self.unit}; allowed: {self.largest:g} "
                f"{self.unit} (stand_ins.signal_max)",
            )
        if float(records["change"].max()) > self.contact:
            return Violation("force_soft", "signal: contact with the sensor")
        return None


@dataclass(frozen=True, slots=True)
class CrashGuard:
    """Stops the arm for its own wrench since the last zero; in retreat, for nothing."""

    RECORD: ClassVar[np.dtype[Any]] = FORCE_LATEST

    force: float
    """Largest force [N]."""
    stale: float
    """Age of the newest wrench that stops the arm [s]."""

    def check(self, now_ns: int, records: np.ndarray | None, mode: Mode) -> Violation | None:
        """Return the reason to stop now, or None; see `rig.core.guard.Guard`."""
        if mode == "retreat":
            return None
        if records is None:
            return Violation("stale_force", "no wrench of the arm has arrived yet")
        late = _stale(
            "newest wrench of the arm",
            now_ns,
            int(records["t_ns"][-1]),
            self.stale,
            "check its cable",
        )
        if late is not None:
            return late
        force = float(np.linalg.norm(records["value"][:, :3], axis=1).max())
        if not force <= self.force:
            return Violation(
                "force_hard",
                f"wrench of the arm: {force:.1f} N since the last zero; allowed: {self.force:.3g} "
                "N, half the rating of the sensor",
            )
        return None
