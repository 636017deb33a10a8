"""Finds the surface by the onset of a sensor's own signal, in and out, so that its delay cancels.

A camera or taxels show a contact late. On the way in, the onset then appears too deep, on the way
out too high by as much, at the same speed: their mean is the surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder import Session, Stream
from recorder.session import linear
from rig.acquire.calibration.onset import (
    Onset,
    Surface,
    TouchedSurface,
    combine,
    find_onset,
    slopes_of,
    student_t,
)
from rig.acquire.calibration.store import tip_heights
from rig.acquire.signal_level import Level, SignalLevel, reading
from rig.core.errors import SafetyStop
from trajectories import PHASES, Plan

Floats = NDArray[np.float64]

METHOD = "onset of the signal, in and out at one speed"
# The deepest part of each way is left out: there the arm turns, and the signal lags behind [m].
_TURNING = 20e-6
# Samples at the start of an approach that are without contact, and the deepest ones, by number.
_REST, _DEEPEST = 12, 4
# Error of the model of the onset: half of an interval [m]. On simulated contacts it stands 0 to
# 12 um too high under a cone, a sphere, a prism and a disc.
_MODEL = 12e-6
# Standard deviations in half of a 95 % interval.
_SIGMAS_95 = 1.96


@dataclass(frozen=True, slots=True)
class Way:
    """Signal on one way down or up."""

    z: Floats
    """Height of the tip (n,) in the contact frame when the samples arrived [m]."""
    change: Floats
    """Change of the signal from no contact (n,)."""


def onset_of(down: Way, up: Way) -> tuple[Onset, float] | None:
    """Return the onset of contact on the ways in and out, and the delay [m]; None: no contact."""
    found = []
    for way in (down, up):
        order = np.argsort(-way.z, kind="stable")
        z, change = way.z[order], way.change[order]
        kept = z > z.min() + _TURNING if len(z) else np.zeros(0, np.bool_)
        onset = find_onset(z[kept], change[kept]) if kept.sum() >= 20 else None
        if onset is None:
            return None
        found.append(onset)
    one, other = found
    half = float(np.hypot(*(np.diff(onset.interval)[0] / 4 for onset in found)))
    middle = (one.z + other.z) / 2
    interval = (middle - half, middle + half)
    both = Onset(middle, interval, one.power, one.force, one.noise)
    return both, (other.z - one.z) / 2


def surface_of(
    approaches: Mapping[int, Sequence[tuple[Onset, float]]], places: Mapping[int, Sequence[float]]
) -> TouchedSurface:
    """Combine the approaches of all points.

    An approach is its onset above what the plan expects, and its delay; the first point is the
    reference. The spread between approaches is pooled over the points, so that two at each are
    enough. From three points on, the surface is a plane through all approaches, whose places (2,)
    are in the contact frame [m].
    """
    groups = {point: [onset for onset, _ in found] for point, found in approaches.items()}
    first = next(iter(groups))
    heights = {point: float(np.mean([each.z for each in found])) for point, found in groups.items()}
    freedom = sum(len(found) - 1 for found in groups.values())
    squares = sum(
        float(np.sum([(each.z - heights[point]) ** 2 for each in found]))
        for point, found in groups.items()
    )
    spread = float(np.sqrt(squares / freedom)) if freedom else float("nan")
    if len(groups) >= 3:
        surface = _on_plane(groups, places, spread)
    elif freedom:
        half = student_t(freedom) * spread / np.sqrt(len(groups[first]))
        within = np.sqrt(
            np.mean([(np.diff(each.interval)[0] / 2) ** 2 for each in groups[first]])
            / len(groups[first])
        )
        half = float(np.hypot(np.hypot(half, within), _MODEL))
        z = heights[first]
        surface = Surface(z, (z - half, z + half), spread)
    else:
        surface = combine(groups[first])
    delays = [delay for found in approaches.values() for _, delay in found]
    slopes = slopes_of(heights, places)
    return TouchedSurface(surface, tuple(groups[first]), heights, slopes, float(np.mean(delays)))


def _on_plane(
    groups: Mapping[int, Sequence[Onset]], places: Mapping[int, Sequence[float]], spread: float
) -> Surface:
    """Return the height at the first point of the plane through all approaches.

    A signal can be weak at one point, such as a marker that is pressed at its centre and does not
    move. So each approach counts by its own interval, and approaches that scatter more widely
    about the plane than their intervals say widen that of the result.
    """
    onsets = [each for found in groups.values() for each in found]
    where = np.array([places[point] for point, found in groups.items() for _ in found], np.float64)
    sigma = np.array([np.diff(each.interval)[0] / 2 / _SIGMAS_95 for each in onsets])
    matrix = np.column_stack([np.ones(len(onsets)), where - where[0]]) / sigma[:, None]
    wanted = np.array([each.z for each in onsets]) / sigma
    found = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    residual = wanted - matrix @ found
    freedom = len(onsets) - 3
    excess = max(1.0, float(residual @ residual) / freedom) if freedom else 1.0
    error = float(np.sqrt(excess * np.linalg.inv(matrix.T @ matrix)[0, 0]))
    half = float(np.hypot((student_t(freedom) if freedom else _SIGMAS_95) * error, _MODEL))
    return Surface(float(found[0]), (float(found[0]) - half, float(found[0]) + half), spread)


def evaluate(session: Session, plan: Plan) -> TouchedSurface:
    """Find the surface in a session of touches along `plan`, of a bench without a gauge."""
    found: dict[int, list[tuple[Onset, float]]] = {}
    places: dict[int, Sequence[float]] = {}
    for target in plan.targets():
        ways = _ways(session, target.index)
        onset = onset_of(*ways)
        if onset is None:
            raise SafetyStop(
                f"home: no contact in the signal at point {target.point}, at the height of the "
                "search; is the sensor tilted against contact_frame, or its light off?"
            )
        expected = target.bottom[2] + target.depth
        both, delay = onset
        low, high = both.interval
        above = Onset(
            both.z - expected,
            (low - expected, high - expected),
            both.power,
            both.force,
            both.noise,
        )
        found.setdefault(target.point, []).append((above, delay))
        places[target.point] = target.origin[:2]
    return surface_of(found, places)


def span_of(session: Session, index: int, phase: str = "normal_inc") -> tuple[int, int]:
    """Return start and end of the last recorded move of target `index` in a phase [ns]."""
    segments = session.segments
    rows = np.flatnonzero(
        (np.asarray(segments["target"]) == index)
        & (np.asarray(segments["phase"]) == PHASES.index(phase))
    )
    if not rows.size:
        raise SafetyStop(f"home: approach {index + 1} was not made")
    row = rows[-1]
    return int(segments["start_ns"][row]), int(segments["end_ns"][row])


def _ways(session: Session, index: int) -> tuple[Way, Way]:
    start, turned = span_of(session, index)
    _, end = span_of(session, index, "normal_dec")
    if session.signal is None:
        raise SafetyStop("home: the session has no signal")
    stream = session.streams[session.signal]
    rows = np.flatnonzero((stream.t_ns >= start) & (stream.t_ns < end))
    times = stream.t_ns[rows]
    z = linear(*tip_heights(session), times).value
    change = _along_contact(np.array(readings_of(stream, rows)), z)
    down = times < turned
    return Way(z[down], change[down]), Way(z[~down], change[~down])


def _along_contact(readings: NDArray[np.float32], z: Floats) -> Floats:
    """Return by how much each reading (n, ...) shows what the deepest ones show (n,).

    This is linear in small changes, and noise cancels. The mean size of the change is not: noise
    hides its beginning, and the surface would seem 0.01 mm too high. The first readings are without
    contact; `z` is the height of the tip (n,) [m].
    """
    flat = readings.reshape(len(readings), -1).astype(np.float64)
    if len(flat) <= _REST:
        return np.zeros(len(flat))
    flat -= flat[:_REST].mean(axis=0)
    deepest = np.argsort(np.nan_to_num(z, nan=np.inf))[:_DEEPEST]
    pattern = flat[deepest].mean(axis=0)
    size = float(np.linalg.norm(pattern))
    return np.asarray(flat @ pattern / size) if size > 0 else np.zeros(len(flat))


def readings_of(stream: Stream, rows: NDArray[np.int64]) -> list[NDArray[np.float32]]:
    """Return the readings of a stream's samples."""
    is_image = stream.traits.kind == "camera"
    return [
        reading((is_image and stream.jpeg(row)) or stream.array("value")[row])
        for row in rows.tolist()
    ]


def levels_of(stream: Stream, rows: NDArray[np.int64]) -> list[Level]:
    """Return the levels of a stream's samples, of which the first ones set the zero."""
    level = SignalLevel(is_image=stream.traits.kind == "camera")
    readings = readings_of(stream, rows)
    for each in readings[:_REST]:
        level.of(each)
    level.zero()
    return [level.of(each) for each in readings]
