"""Guards that stand in for a force gauge: the sensor's own signal, and the arm's own wrench.

Neither measures the force on the sensor. The signal is late and has no unit of force; the arm's
wrench is wrong by up to a third and by a few newtons. Each has its own limit, far below the
rating of the sensor.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rig.core.guard import Mode, Travelled, Violation, at_rest, stale
from rig.core.samples import FORCE_LATEST, SIGNAL_LATEST


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
    way: float = math.inf
    """Way in contact without a change beyond noise that stops the arm [m]."""

    def check(
        self, now_ns: int, records: np.ndarray | None, mode: Mode, travelled: Travelled = at_rest
    ) -> Violation | None:
        """Return the reason to stop now, or None; see `rig.core.guard.Guard`."""
        if mode == "retreat":
            return None
        if records is None:
            return Violation("stale_force", "no signal of the sensor has arrived yet")
        for what, field, cause in (
            ("signal", "t_ns", "check the sensor and its cable"),
            (
                "signal that changed",
                "fresh_ns",
                "the sensor repeats one picture or reading: is it frozen?",
            ),
        ):
            t_ns = int(records[field][-1])
            if late := stale("stale_force", what, now_ns, t_ns, self.stale, cause):
                return late
        gone = travelled(int(records["moved_ns"][-1]))
        if gone > self.way:
            return Violation(
                "stale_force",
                f"the signal has shown nothing but noise for {1e3 * gone:.2f} mm in contact; "
                f"allowed: {1e3 * self.way:.2f} mm; does the sensor repeat itself?",
            )
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

    def check(
        self, now_ns: int, records: np.ndarray | None, mode: Mode, travelled: Travelled = at_rest
    ) -> Violation | None:
        """Return the reason to stop now, or None; see `rig.core.guard.Guard`."""
        if mode == "retreat":
            return None
        if records is None:
            return Violation("stale_force", "no wrench of the arm has arrived yet")
        t_ns, cause = int(records["t_ns"][-1]), "check its cable"
        if late := stale("stale_force", "wrench of the arm", now_ns, t_ns, self.stale, cause):
            return late
        force = float(np.linalg.norm(records["value"][:, :3], axis=1).max())
        if not force <= self.force:
            return Violation(
                "force_hard",
                f"wrench of the arm: {force:.1f} N since the last zero; allowed: {self.force:.3g} "
                "N, half the rating of the sensor",
            )
        return None
