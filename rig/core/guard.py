"""Decides when the arm must stop: force, position, stale data, safety state. Pure logic, no I/O.

The UR's own limits cannot protect the sensor: their tolerance is 25 N, a Nano17's range ends at
17 N. The process that moves the arm therefore asks its guards a few hundred times a second.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike

from rig.core.clock import SECOND_NS
from rig.core.geometry import invert, matrix_from_vector, transform
from rig.core.samples import FORCE_LATEST, POSE_LATEST
from trajectories import dome_height

Mode = Literal["guarded", "retreat", "travel"]
# Returns how far the tip has gone in contact since a time [ns], in [m].
Travelled = Callable[[int], float]
# Kinds of violations from the most serious to the least; a stale force above the soft limit means a
# lost sensor, not a finished press.
Kind = Literal[
    "emergency_stop",
    "protective_stop",
    "force_hard",
    "stale_force",
    "stale_pose",
    "force_status",
    "force_soft",
    "box",
]

AXES = (("Fx", "N"), ("Fy", "N"), ("Fz", "N"), ("Tx", "N m"), ("Ty", "N m"), ("Tz", "N m"))

# The slope of four samples 4 ms apart, extrapolated 20 ms ahead, has 2.2 times the noise of one
# sample; with fewer samples the noise would trip the guard. If four samples take longer than the
# span, the sensor is too slow to predict the next 20 ms.
_SLOPE_WINDOW_NS = 12_000_000
_SLOPE_SAMPLES = 4
_SLOPE_SPAN_NS = 60_000_000

# In retreat, the load counts as growing if it gains this fraction of the rating in `horizon`, and
# grows from each to the next of this number of records.
_GROWTH, _GROWING = 0.02, 3
# A force of this multiple of its rating is none: gauges saturate at 1 to 2 times theirs. One such
# record is a fault of the line, two in a row are not.
IMPOSSIBLE = 5.0

# The tip is in contact this far below the surface [m], which is not flat; places that are kept.
_SUNK, _PLACES = 0.1e-3, 2048

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
    axes_measured: tuple[str, ...] = tuple(name for name, _ in AXES)
    """Axes that the F/T sensor measures; values of the others are ignored, NaN or not."""
    dome_radius: float | None = None
    """Radius of the sensor's spherical top [m], from which the box's depth is measured; None:
    flat."""

    def __post_init__(self) -> None:
        if len(self.force_rating) != 6 or not all(rating > 0 for rating in self.force_rating):
            raise ValueError(f"force_rating: {self.force_rating}; allowed: 6 numbers above 0")
        if not 0 < self.soft_fraction <= self.hard_fraction:
            raise ValueError(
                f"soft_fraction: {self.soft_fraction}; allowed: above 0, up to hard_fraction "
                f"({self.hard_fraction})"
            )
        if not all(low < high for low, high in zip(*self.box, strict=True)):
            raise ValueError(f"box: {self.box}; allowed: lower corner below the upper one")


@dataclass(frozen=True, slots=True)
class Violation:
    """Reason to stop the arm."""

    kind: Kind
    reason: str
    """Message for the technician: value found, limit, units."""


def most_serious(violations: Iterable[Violation]) -> Violation | None:
    """Return the most serious of the violations that several guards found, or None."""
    return min(violations, key=lambda found: get_args(Kind).index(found.kind), default=None)


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

    The box is in the contact frame, a pose (6,) in the base frame [m, rad].
    """
    return _box_reason(limits, transform(invert(contact_frame), position))


def _box_reason(limits: GuardLimits, point: ArrayLike) -> str | None:
    position = np.asarray(point, np.float64).tolist()
    (low_x, low_y, low_z), upper = limits.box
    lower = (low_x, low_y, low_z + dome_height(limits.dome_radius, position[0], position[1]))
    for name, value, low, high in zip("xyz", position, lower, upper, strict=True):
        # Negated, so that NaN is outside too.
        if not low <= value <= high:
            return (
                f"TCP outside the allowed box: {name} = {value * 1e3:.2f} mm in the contact frame, "
                f"allowed {low * 1e3:.2f} to {high * 1e3:.2f} mm"
            )
    return None


def _missing(kind: Kind, record: str) -> Violation:
    return Violation(kind, f"no {record} has arrived yet: is its stream running?")


def stale(
    kind: Kind, record: str, now_ns: int, t_ns: int, limit: float, cause: str
) -> Violation | None:
    """Return the violation of a record of `t_ns` that is older than `limit` [s], or None."""
    age_ns = now_ns - t_ns
    if age_ns <= round(limit * SECOND_NS):
        return None
    return Violation(
        kind, f"newest {record} is {age_ns / 1e6:.0f} ms old, allowed {limit * 1e3:.0f} ms; {cause}"
    )


def at_rest(_since_ns: int) -> float:
    """Return the way of a tip that does not move [m]."""
    return 0.0


class Guard(Protocol):
    """One reason to stop the arm, watched in a record that another process shares."""

    RECORD: ClassVar[np.dtype[Any]]
    """Dtype of the record."""

    def check(
        self, now_ns: int, records: np.ndarray | None, mode: Mode, travelled: Travelled = at_rest
    ) -> Violation | None:
        """Return the reason to stop at `now_ns`, in a motion of this mode, or None.

        `records` (n,) are all since the last check, oldest first; the newest again if none is new;
        None before the first. `travelled` returns how far the tip has gone in contact since a time.
        """


class MotionGuard:
    """Stops the arm for its controller's safety status, missing poses, or leaving the box.

    In retreat, the box and missing poses do not stop it. The contact frame is a pose (6,) in the
    base frame [m, rad].
    """

    RECORD: ClassVar[np.dtype[Any]] = POSE_LATEST

    def __init__(self, limits: GuardLimits, contact_frame: ArrayLike) -> None:
        self._limits = limits
        to_contact = invert(contact_frame)
        # Done once: converting a rotation vector to a matrix would be most of the cost of a check.
        self._turn, self._shift = matrix_from_vector(to_contact[3:]), to_contact[:3]
        self._touching: deque[tuple[int, list[float]]] = deque(maxlen=_PLACES)

    def travelled(self, since_ns: int) -> float:
        """Return how far the tip has gone in contact since a time [m]."""
        first = None
        for t_ns, place in reversed(self._touching):
            if t_ns <= since_ns:
                break
            first = place
        return 0.0 if first is None else math.dist(first, self._touching[-1][1])

    def check(self, now_ns: int, records: np.ndarray | None, mode: Mode) -> Violation | None:
        """Return the reason to stop now, or None; see `Guard`."""
        if records is None:
            return None if mode == "retreat" else _missing("stale_pose", "pose")
        safety = judge_safety(int(np.bitwise_or.reduce(records["safety_status"])))
        if safety is not None or mode == "retreat":
            self._touching.clear()
            return safety
        newest_ns, limit = int(records["t_ns"][-1]), self._limits.stale_pose
        cause = "check the pose stream and its cable"
        late = stale("stale_pose", "pose", now_ns, newest_ns, limit, cause)
        if late is not None:
            return late
        places = records["value"][:, :3] @ self._turn.T + self._shift
        for t_ns, place in zip(records["t_ns"].tolist(), places.tolist(), strict=True):
            reason = _box_reason(self._limits, place)
            if reason is not None:
                return Violation("box", reason)
            if place[2] > dome_height(self._limits.dome_radius, *place[:2]) - _SUNK:
                self._touching.clear()
            elif not self._touching or t_ns > self._touching[-1][0]:
                self._touching.append((t_ns, place))
        return None


class ForceGuard:
    """Stops the arm for the load on an F/T sensor, or for missing or invalid forces.

    Modes: "guarded" checks everything. "travel" does too; no contact is expected, so any force that
    trips is unexpected. "retreat" lets the arm leave even if the sensor fails: no soft limit, no
    check of age, and the hard limit only while the load still grows, in three records. A single
    record of a size that no gauge sends is left out; the next one like it stops the arm.
    Reasons have the name of the sensor; empty: the bench has only one.
    """

    RECORD: ClassVar[np.dtype[Any]] = FORCE_LATEST

    def __init__(self, limits: GuardLimits, name: str = "") -> None:
        self._limits = limits
        self._prefix = f"{name}: " if name else ""
        self._measured = np.array([name in limits.axes_measured for name, _ in AXES])
        self._history: deque[tuple[int, list[float]]] = deque(maxlen=64)
        self._impossible_ns: int | None = None

    def check(
        self, now_ns: int, records: np.ndarray | None, mode: Mode, travelled: Travelled = at_rest
    ) -> Violation | None:
        """Return the reason to stop now, or None; see `Guard`."""
        violation = self._check(now_ns, records, mode)
        if violation is None or not self._prefix:
            return violation
        return replace(violation, reason=f"{self._prefix}{violation.reason}")

    def _check(self, now_ns: int, records: np.ndarray | None, mode: Mode) -> Violation | None:
        if records is None:
            return None if mode == "retreat" else _missing("stale_force", "force")
        limits = self._limits
        arrived_ns, cause = int(records["t_ns"][-1]), "check the F/T sensor and its cable"
        late = stale("stale_force", "force", now_ns, arrived_ns, limits.stale_force, cause)
        records = records[~self._single_impossible(records)]
        forces = np.where(self._measured, records["value"], 0.0)
        newest_ns = self._history[-1][0] if self._history else -1
        for t_ns, force in zip(records["t_ns"].tolist(), forces.tolist(), strict=True):
            if t_ns > newest_ns:
                self._history.append((t_ns, force))
        if mode == "retreat":
            # A sensor lost under load must not keep the arm there, nor a few bad records.
            return None if late is not None else self._growing()
        if not len(records):
            return late
        newest = forces[-1].tolist()
        ahead = self._predict() or newest
        # The force that is largest in size on each axis: a load between two looks counts.
        largest = forces[np.abs(forces).argmax(axis=0), np.arange(6)].tolist()
        loads, invalid = self._loads(largest), self._invalid(records, forces)
        for k, load in enumerate(loads):
            if invalid is None and load > limits.hard_fraction:
                return self._hard(k, largest)
        return late or invalid or self._soft(loads, largest, newest, ahead)

    def _single_impossible(self, records: np.ndarray) -> np.ndarray:
        """Return True for records (n,) of a size that no gauge sends, after one that is none."""
        rating = np.asarray(self._limits.force_rating)
        sizes = np.where(self._measured, np.abs(records["value"]) / rating, 0.0)
        wrong = (sizes > IMPOSSIBLE).any(axis=1)
        wrong &= records["status"] & self._limits.force_status_mask == 0
        first_ns, before_ns = int(records["t_ns"][0]), self._impossible_ns
        before = before_ns is not None and before_ns != first_ns
        self._impossible_ns = int(records["t_ns"][-1]) if wrong[-1] else None
        return np.asarray(wrong & ~np.append(before, wrong[:-1]))

    def _growing(self) -> Violation | None:
        """Return the violation of a load beyond the hard limit that still grows, or None."""
        last = [force for _t_ns, force in list(self._history)[-_GROWING:]]
        ahead = self._predict()
        if ahead is None or len(last) < _GROWING:
            return None
        loads = np.array([self._loads(force) for force in (*last, ahead)])
        least = np.append(np.zeros(_GROWING - 1), _GROWTH)[:, None]
        grows = (loads[0] > self._limits.hard_fraction) & (np.diff(loads, axis=0) > least).all(0)
        return self._hard(int(np.argmax(grows)), last[-1]) if grows.any() else None

    def _hard(self, load: int, force: list[float]) -> Violation:
        name, text = self._said(load, force)
        limit = self._limits.hard_fraction
        return Violation("force_hard", f"{name}: {text}, the hard limit is {limit:.0%}")

    def _invalid(self, records: np.ndarray, forces: np.ndarray) -> Violation | None:
        status = int(np.bitwise_or.reduce(records["status"])) & self._limits.force_status_mask
        finite = np.isfinite(forces).all(axis=0)
        if not status and finite.all():
            return None
        bad = [name for (name, _), each in zip(AXES, finite, strict=True) if not each]
        which = f", {', '.join(bad)} not a number" if bad else ""
        return Violation(
            "force_status",
            f"the F/T sensor reports invalid values (status 0x{status:x}{which}): "
            "overloaded, or a cable is loose",
        )

    def _soft(
        self, loads: list[float], largest: list[float], newest: list[float], ahead: list[float]
    ) -> Violation | None:
        limit = self._limits.soft_fraction
        all_loads = zip(loads, self._loads(newest), self._loads(ahead), strict=True)
        for k, (load, load_newest, load_later) in enumerate(all_loads):
            if load > limit:
                name, text = self._said(k, largest)
                return Violation("force_soft", f"{name}: {text}, the soft limit is {limit:.0%}")
            if load_later > limit and load_later > load_newest:
                name, text = self._said(k, newest)
                return Violation(
                    "force_soft",
                    f"{name}: {text}, in {self._limits.horizon * 1e3:.0f} ms "
                    f"{self._said(k, ahead)[1]}, the soft limit is {limit:.0%}",
                )
        return None

    def _loads(self, force: list[float]) -> list[float]:
        """Return the load on each axis as a fraction of its rating."""
        rating = self._limits.force_rating
        return [abs(value) / most for value, most in zip(force, rating, strict=True)]

    def _said(self, axis: int, force: list[float]) -> tuple[str, str]:
        """Return the name and the text of the load on an axis, by its index."""
        (name, unit), most = AXES[axis], self._limits.force_rating[axis]
        fraction = abs(force[axis]) / most
        return name, f"{force[axis]:.3g} {unit} ({fraction:.0%} of {most:g} {unit})"

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
