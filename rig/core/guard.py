"""Decides when the arm must stop: force, position, stale data, safety state. Pure logic, no I/O.

The UR's own limits cannot protect the sensor: their tolerance is 25 N, a Nano17's range ends at
17 N. The process that moves the arm therefore calls this guard a few hundred times a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from rig.core.clock import SECOND_NS
from rig.core.geometry import invert, matrix_from_vector, transform
from trajectories import dome_height

Mode = Literal["guarded", "retreat", "travel"]
Kind = Literal[
    "force_soft",
    "force_hard",
    "force_status",
    "stale_force",
    "stale_pose",
    "box",
    "protective_stop",
    "emergency_stop",
]

AXES = (("Fx", "N"), ("Fy", "N"), ("Fz", "N"), ("Tx", "N m"), ("Ty", "N m"), ("Tz", "N m"))

# The slope of four samples 4 ms apart, extrapolated 20 ms ahead, has 2.2 times the noise of one
# sample; with fewer samples the noise would trip the guard. If four samples take longer than the
# span, the sensor is too slow to predict the next 20 ms.
_SLOPE_WINDOW_NS = 12_000_000
_SLOPE_SAMPLES = 4
_SLOPE_SPAN_NS = 60_000_000

# In retreat, the load counts as growing if it gains this fraction of the rating in `horizon`.
_GROWTH = 0.02

# RTDE safety_status_bits: 5, 6, 7 emergency stops, 8 violation; 2 protective, 4 safeguard (a door,
# a light curtain), 9 fault, 10 stopped by any of them.
_EMERGENCY_BITS = 0x1E0
_STOPPED_BITS = 0x614


@dataclass(frozen=True, slots=True)
class GuardLimits:
    """Limits of the sensor, the F/T sensor and the bench."""

    force_rating: tuple[float, ...]
    """Largest load per axis (6,) in the F/T frame [N, N m]: the lower of F/T sensor and sensor."""
    box: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Lower and upper corner for the TCP in the contact frame [m]; minus lower z is the depth."""
    soft_fraction: float = 0.85
    """Fraction of the rating that ends a press as force-limited and continues the session."""
    hard_fraction: float = 1.0
    """Fraction of the rating that stops the run for inspection."""
    horizon: float = 0.02
    """The soft limit also trips if force plus slope times this time would exceed it [s]."""
    stale_force: float = 0.05
    """A force record older than this stops the arm [s]."""
    stale_pose: float = 0.1
    """A pose record older than this stops the arm [s]."""
    force_status_mask: int = 0
    """Status bits of the F/T sensor that mark its values as invalid (saturation and others)."""
    combined_fraction: float | None = None
    """Limit on the summed fractions of (Fxy, Tz) and (Fz, Txy); ATI's rule is 1.05. None: off."""
    axes_measured: tuple[str, ...] = tuple(name for name, _ in AXES)
    """Axes that the F/T sensor measures; values of the others are ignored, NaN or not."""
    dome_radius: float | None = None
    """Radius of the sensor's spherical top [m], from which the box's depth is measured; None:
    flat."""

    def __post_init__(self) -> None:
        """Reject limits that would never trip, or always.

        Raises:
            ValueError: Names the field, its value and the allowed values.
        """
        if len(self.force_rating) != 6 or not all(rating > 0 for rating in self.force_rating):
            raise ValueError(f"force_rating: {self.force_rating}; allowed: 6 numbers above 0")
        if not 0 < self.soft_fraction <= self.hard_fraction:
            raise ValueError(
                f"soft_fraction: {self.soft_fraction}; allowed: above 0, up to hard_fraction "
                f"({self.hard_fraction})"
            )
        if not all(low < high for low, high in zip(*self.box, strict=True)):
            raise ValueError(f"box: {self.box}; allowed: lower corner below the upper one")
        names = [name for name, _ in AXES]
        if not self.axes_measured or not set(self.axes_measured) <= set(names):
            raise ValueError(
                f"axes_measured: {self.axes_measured}; allowed: one or more of {', '.join(names)}"
            )


@dataclass(frozen=True, slots=True)
class Violation:
    """Reason to stop the arm."""

    kind: Kind
    reason: str
    """Message for the technician: value found, limit, units."""


# Violations from the most serious to the least; a stale force above the soft limit means a lost
# sensor, not a finished press.
_SEVERITY: tuple[Kind, ...] = (
    "emergency_stop",
    "protective_stop",
    "force_hard",
    "stale_force",
    "stale_pose",
    "force_status",
    "force_soft",
    "box",
)


def most_serious(violations: Iterable[Violation]) -> Violation | None:
    """Return the most serious of the violations that several guards found, or None."""
    return min(violations, key=lambda found: _SEVERITY.index(found.kind), default=None)


def judge_safety(status: int) -> Violation | None:
    """Return the reason to stop given by RTDE's safety_status_bits, None if the arm may move."""
    if status & _EMERGENCY_BITS:
        return Violation(
            "emergency_stop",
            f"emergency stop or safety violation (status bits 0x{status:x}): make the bench safe, "
            "then release it at the pendant",
        )
    if status & _STOPPED_BITS:
        return Violation(
            "protective_stop",
            f"the controller made a protective or safeguard stop (status bits 0x{status:x}): look "
            "for the cause, then unlock it at the pendant; nothing is reset from here",
        )
    return None


def outside_box(limits: GuardLimits, contact_frame: ArrayLike, position: ArrayLike) -> str | None:
    """Return the reason why a TCP position (3,) in the base frame [m] is outside the box, or None.

    Args:
        limits: Limits with the box in the contact frame.
        contact_frame: Pose (6,) of the contact frame in the base frame [m, rad].
        position: Position of the TCP.
    """
    return _box_reason(limits, transform(invert(contact_frame), position))


def _box_reason(limits: GuardLimits, point: ArrayLike) -> str | None:
    found = np.asarray(point, np.float64).tolist()
    (low_x, low_y, low_z), upper = limits.box
    lower = (low_x, low_y, low_z + dome_height(limits.dome_radius, found[0], found[1]))
    for name, value, low, high in zip("xyz", found, lower, upper, strict=True):
        # Negated, so that NaN is outside too.
        if not low <= value <= high:
            return (
                f"TCP outside the allowed box: {name} = {value * 1e3:.2f} mm in the contact frame, "
                f"allowed {low * 1e3:.2f} to {high * 1e3:.2f} mm"
            )
    return None


class Guard:
    """Checks each new force and pose record and decides if the arm may continue.

    Modes: "guarded" checks everything. "travel" does too; no contact is expected, so any force that
    trips is unexpected. "retreat" lets the arm leave even if sensors fail: no soft limit, no box
    or stale-data check, and the hard limit only while the load still grows.

    Args:
        limits: Limits to enforce.
        contact_frame: Pose (6,) of the contact frame in the base frame [m, rad].
        watch_force: Stop without a force record; False on a bench without F/T sensor.
        watch_pose: Stop without a pose record.
    """

    def __init__(
        self,
        limits: GuardLimits,
        contact_frame: ArrayLike,
        *,
        watch_force: bool = True,
        watch_pose: bool = True,
    ) -> None:
        self._limits = limits
        to_contact = invert(contact_frame)
        # Done once: converting a rotation vector to a matrix would be most of the cost of a check.
        self._turn, self._shift = matrix_from_vector(to_contact[3:]), to_contact[:3]
        self._measured = tuple(name in limits.axes_measured for name, _ in AXES)
        self._watch_force = watch_force
        self._watch_pose = watch_pose
        self._history: deque[tuple[int, list[float]]] = deque(maxlen=64)

    def check(
        self,
        now_ns: int,
        force_record: Any | None,
        pose_record: Any | None,
        mode: Mode = "guarded",
    ) -> Violation | None:
        """Return the most serious reason to stop now, or None.

        Args:
            now_ns: Time [ns].
            force_record: Newest FORCE_LATEST record.
            pose_record: Newest POSE_LATEST record.
            mode: Current motion of the arm.
        """
        safety = None if pose_record is None else judge_safety(int(pose_record["safety_status"]))
        force = self._check_force(now_ns, force_record, mode)
        if safety is not None or (force is not None and force.kind == "force_hard"):
            return safety or force
        # A stale force above the soft limit means a lost sensor, not a finished press.
        return (
            self._check_age(now_ns, force_record, pose_record, mode)
            or force
            or self._check_box(pose_record, mode)
        )

    def _check_age(
        self, now_ns: int, force: Any | None, pose: Any | None, mode: Mode
    ) -> Violation | None:
        if mode == "retreat":
            return None
        for what, kind, watched, record, limit in (
            ("force", "stale_force", self._watch_force, force, self._limits.stale_force),
            ("pose", "stale_pose", self._watch_pose, pose, self._limits.stale_pose),
        ):
            if not watched:
                continue
            stale: Kind = "stale_force" if kind == "stale_force" else "stale_pose"
            if record is None:
                return Violation(stale, f"no {what} has arrived yet: is its stream running?")
            age_ns = now_ns - int(record["t_ns"])
            if age_ns > round(limit * SECOND_NS):
                return Violation(
                    stale,
                    f"newest {what} is {age_ns / 1e6:.0f} ms old, allowed {limit * 1e3:.0f} ms: "
                    f"check the {'F/T sensor' if what == 'force' else 'pose stream'} and its cable",
                )
        return None

    def _check_box(self, pose: Any | None, mode: Mode) -> Violation | None:
        if pose is None or mode == "retreat":
            return None
        reason = _box_reason(self._limits, self._turn @ pose["value"][:3] + self._shift)
        return Violation("box", reason) if reason else None

    def _check_force(self, now_ns: int, record: Any | None, mode: Mode) -> Violation | None:
        if record is None or not self._watch_force:
            return None
        limits = self._limits
        t_ns = int(record["t_ns"])
        force = [
            float(value) if measured else 0.0
            for value, measured in zip(record["value"], self._measured, strict=True)
        ]
        if not self._history or t_ns > self._history[-1][0]:
            self._history.append((t_ns, force))
        if mode == "retreat" and now_ns - t_ns > round(limits.stale_force * SECOND_NS):
            # A sensor lost under load must not keep the arm there.
            return None
        status = int(record["status"]) & limits.force_status_mask
        if mode != "retreat" and (status or not all(map(math.isfinite, force))):
            bad = [
                name
                for (name, _), value in zip(AXES, force, strict=True)
                if not math.isfinite(value)
            ]
            which = f", {', '.join(bad)} not a number" if bad else ""
            return Violation(
                "force_status",
                f"the F/T sensor reports invalid values (status 0x{status:x}{which}): "
                "overloaded, or a cable is loose",
            )
        ahead = self._predict()
        loads = self._loads(force)
        later = self._loads(ahead) if ahead is not None else loads
        for (name, text, load), (_, _, load_later) in zip(loads, later, strict=True):
            if load > limits.hard_fraction:
                if mode == "retreat" and not load_later > load + _GROWTH:
                    continue
                return Violation(
                    "force_hard", f"{name}: {text}, the hard limit is {limits.hard_fraction:.0%}"
                )
        if mode == "retreat":
            return None
        for (name, text, load), (_, text_later, load_later) in zip(loads, later, strict=True):
            if load > limits.soft_fraction:
                return Violation(
                    "force_soft", f"{name}: {text}, the soft limit is {limits.soft_fraction:.0%}"
                )
            if load_later > limits.soft_fraction and load_later > load:
                return Violation(
                    "force_soft",
                    f"{name}: {text}, in {limits.horizon * 1e3:.0f} ms {text_later}, "
                    f"the soft limit is {limits.soft_fraction:.0%}",
                )
        return None

    def _loads(self, force: list[float]) -> list[tuple[str, str, float]]:
        """Return name, text and fraction of rating of each axis, and of limited combined loads."""
        rating = self._limits.force_rating
        fractions = [abs(value) / most for value, most in zip(force, rating, strict=True)]
        loads = [
            (name, f"{value:.3g} {unit} ({fraction:.0%} of {most:g} {unit})", fraction)
            for (name, unit), value, most, fraction in zip(
                AXES, force, rating, fractions, strict=True
            )
        ]
        if self._limits.combined_fraction is not None:
            for name, total in (
                ("Fxy and Tz together", math.hypot(fractions[0], fractions[1]) + fractions[5]),
                ("Fz and Txy together", fractions[2] + math.hypot(fractions[3], fractions[4])),
            ):
                fraction = total / self._limits.combined_fraction
                loads.append((name, f"{total:.0%} of their ratings", fraction))
        return loads

    def _predict(self) -> list[float] | None:
        """Return the wrench `horizon` after the newest sample, or None with too few samples.

        An axis moving towards zero keeps its value: fast unloading is no reason to stop.
        """
        newest_ns, newest = self._history[-1]
        recent = [
            (t_ns, force)
            for k, (t_ns, force) in enumerate(reversed(self._history))
            if k < _SLOPE_SAMPLES or newest_ns - t_ns <= _SLOPE_WINDOW_NS
        ]
        span_ns = newest_ns - recent[-1][0]
        if len(recent) < _SLOPE_SAMPLES or span_ns > _SLOPE_SPAN_NS:
            return None
        times = [(t_ns - newest_ns) / SECOND_NS for t_ns, _ in recent]
        mean = sum(times) / len(times)
        spread = sum((t - mean) ** 2 for t in times)
        ahead = []
        for axis, value in enumerate(newest):
            centred = zip(times, (force[axis] for _, force in recent), strict=True)
            slope = sum((t - mean) * f for t, f in centred) / spread
            ahead.append(value + slope * self._limits.horizon if slope * value > 0 else value)
        return ahead
