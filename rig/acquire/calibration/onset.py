"""Onset of contact, found by fitting a model to the force instead of crossing a threshold.

Above the surface the force is constant, below it grows as k d^p (1 + c d): p is 1 for a flat punch,
1.5 for a sphere (Hertz), 2 for a cone (Johnson 1985, 4 and 5). The correction c accounts for a thin
layer's stiffening and for relaxation. A threshold would be crossed deeper on a softer gel.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.session import Session, Stream, linear
from rig.acquire.calibration.store import tip_heights
from rig.acquire.signal_level import Level, SignalLevel, reading
from rig.core.errors import SafetyStop
from trajectories import PHASES, Plan

Floats = NDArray[np.float64]

_POWERS = np.arange(1.0, 2.01, 0.1)
# Least number of samples of an approach.
_LEAST = 20
# Samples are averaged to about this many points: the fit is the same, but fast.
_POINTS = 400
# Number of heights tried along the whole approach, then around the best one.
_COARSE, _FINE = 100, 81
# Forces and poses are matched in time to a few milliseconds; at 1 mm/s this is [m].
_TIMING = 3e-6
# The 95 % interval holds the heights whose likelihood ratio is below this (Wilks, one parameter).
_CHI2_95 = 3.841
# Error of the model's shape, over the depth of an approach: five simulated tips on five skins that
# relax have onsets 0.3 % too high to 1.1 % too deep. The middle is taken off.
_TOO_DEEP, _SHAPE = 0.004, 0.007
# Student's t for 95 % at 1 to 14 degrees of freedom.
_T_95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18, 2.16, 2.14)


@dataclass(frozen=True, slots=True)
class Onset:
    """Onset of contact in one approach."""

    z: float
    """Height of first contact in the frame of the input [m]."""
    interval: tuple[float, float]
    """95 % profile-likelihood interval of `z` [m]."""
    power: float
    """Exponent of the force's increase."""
    force: float
    """Largest force of the approach above its zero [N]."""
    noise: float
    """Standard deviation of a force sample about the model [N]."""
    shape: float = 0.0
    """Error of the model's shape, which all approaches share [m]."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Surface height from several approaches at one point."""

    z: float
    """Height of the surface [m]."""
    interval: tuple[float, float]
    """95 % interval of `z` [m]."""
    spread: float
    """Standard deviation between approaches [m]; NaN for a single one."""

    @property
    def width(self) -> float:
        """Width of the interval [m]."""
        return self.interval[1] - self.interval[0]


@dataclass(frozen=True, slots=True)
class TouchedSurface:
    """Surface under the points of a session of touches."""

    surface: Surface
    """Height at the first point, with its interval."""
    onsets: tuple[Onset, ...]
    """Onsets at the first point, one for each approach."""
    heights: Mapping[int, float]
    """Height at each point [m]; by a signal, above what the plan expects there."""
    slopes: tuple[float, float] | None
    """Tilt along x and y [rad]; None unless three points were touched."""
    delay: float = 0.0
    """Mean delay of the signal behind the pose at the speed of the approaches [m]."""


def slopes_of(
    heights: Mapping[int, float], places: Mapping[int, Sequence[float]]
) -> tuple[float, float] | None:
    """Return the tilt along x and y [rad] by heights at places (2,) [m]; None below 3 points."""
    if len(heights) < 3:
        return None
    xy = np.array([places[point] for point in heights], np.float64)
    return tilt(xy, np.array(list(heights.values())))[:2]


def find_onset(z: Floats, force: Floats) -> Onset | None:
    """Fit zero force, then a power of depth; return None if the force never exceeds its noise.

    `z` are heights of the tip (n,) along one approach, from above downward [m], `force` the
    compression (n,) at them, positive [N].
    """
    z, force = np.asarray(z, np.float64), np.asarray(force, np.float64)
    if z.shape != force.shape or len(z) < _LEAST:
        raise ValueError(
            f"approach: found {z.shape} heights and {force.shape} forces; at least {_LEAST}"
        )
    if not (np.isfinite(z).all() and np.isfinite(force).all()):
        raise ValueError("approach: values that are not finite; is a sensor disconnected?")
    z, force = _averaged(z, force)
    top, bottom = float(z.max()), float(z.min())
    grid = np.linspace(bottom, top, _COARSE + 2)[1:-1]
    for width in ((top - bottom) / _COARSE, (top - bottom) / _COARSE / 10):
        cost, power = _profile(z, force, grid)
        best = int(cost.argmin())
        centre = float(grid[best])
        grid = np.linspace(centre - 4 * width, centre + 4 * width, _FINE)
    cost, power = _profile(z, force, grid)
    best = int(cost.argmin())
    height, exponent = float(grid[best]), float(power[best])
    residual, rise = _residual(z, force, height, exponent)
    freedom = len(z) - 5
    variance = float(residual @ residual) / freedom
    flat = float(np.var(force)) * len(z)
    # Without contact a flat line fits as well: a rise must explain far more than noise.
    gained = flat - float(cost[best])
    if not (gained > 50 * variance and rise > 3 * np.sqrt(variance)):
        return None
    limit = float(cost[best]) + _CHI2_95 * variance * _inflation(residual)
    low, high = _interval(z, force, height, limit, top - bottom)
    noise, depth = float(np.sqrt(variance)), height - bottom
    off = _TOO_DEEP * depth
    interval = low + off, high + off
    return Onset(height + off, interval, exponent, rise, noise, _SHAPE * depth)


def combine(onsets: Sequence[Onset]) -> Surface:
    """Combine repeated approaches: the mean of their heights, with an interval.

    The half-width is the larger of Student's t times the standard error between approaches, and
    the root mean square half-width of the single intervals divided by the root of their number.
    The error of the model's shape is added in squares, and more approaches do not reduce it.
    """
    if not onsets:
        raise ValueError("onsets: found none; allowed: at least one")
    heights = np.array([onset.z for onset in onsets])
    halves = np.array([(onset.interval[1] - onset.interval[0]) / 2 for onset in onsets])
    count = len(onsets)
    mean = float(heights.mean())
    within = float(np.sqrt(np.mean(halves**2) / count))
    shape = float(np.mean([onset.shape for onset in onsets]))
    if count == 1:
        low, high = (float(np.hypot(end - mean, shape)) for end in onsets[0].interval)
        return Surface(mean, (mean - low, mean + high), float("nan"))
    spread = float(heights.std(ddof=1))
    across = student_t(count - 1) * spread / np.sqrt(count)
    half = float(np.linalg.norm([max(within, float(across)), _TIMING, shape]))
    return Surface(mean, (mean - half, mean + half), spread)


def student_t(freedom: int) -> float:
    """Return Student's t for 95 % at 1 or more degrees of freedom; from 14 on, 2.14."""
    return _T_95[min(freedom, len(_T_95)) - 1]


def tilt(places: Floats, heights: Floats) -> tuple[float, float, float]:
    """Fit a plane to surface heights; return slopes along x and y [rad] and height at origin [m].

    Three or more places (n, 2), not on one line, have the heights (n,) [m].
    """
    matrix = np.column_stack([places, np.ones(len(places))])
    if len(places) < 3 or np.linalg.matrix_rank(matrix, tol=1e-9) < 3:
        raise ValueError(f"places: found {len(places)} that span no plane; allowed: 3 or more")
    slope_x, slope_y, height = np.linalg.lstsq(matrix, heights, rcond=None)[0].tolist()
    return slope_x, slope_y, height


def _averaged(z: Floats, force: Floats) -> tuple[Floats, Floats]:
    step = max(len(z) // _POINTS, 1)
    whole = len(z) - len(z) % step
    # The end of the approach counts most: an incomplete group is left out at its start.
    z, force = z[len(z) - whole :], force[len(force) - whole :]
    return z.reshape(-1, step).mean(axis=1), force.reshape(-1, step).mean(axis=1)


def _profile(z: Floats, force: Floats, grid: Floats) -> tuple[Floats, Floats]:
    """Return the least sum of squares at each height (m,) over exponents, and its exponent."""
    depth = np.maximum(grid[:, None] - z[None, :], 0.0)
    depth /= max(float(depth.max()), 1e-12)
    centred = force - force.mean()
    total = float(centred @ centred)
    cost = np.full(len(grid), total)
    power = np.full(len(grid), _POWERS[0])
    for exponent in _POWERS:
        first = depth**exponent
        second = first * depth
        first -= first.mean(axis=1, keepdims=True)
        second -= second.mean(axis=1, keepdims=True)
        aa = np.einsum("ij,ij->i", first, first)
        ab = np.einsum("ij,ij->i", first, second)
        bb = np.einsum("ij,ij->i", second, second)
        ay, by = first @ centred, second @ centred
        # Least squares for two shapes, by Cramer's rule.
        space = aa * bb - ab**2
        solvable = space > 1e-9 * aa * bb
        space = np.where(solvable, space, 1.0)
        k, c = (bb * ay - ab * by) / space, (aa * by - ab * ay) / space
        # Beyond a factor of 2 at full depth it would no longer be a correction; a force that
        # falls on contact is no contact.
        fine = solvable & (k > 0) & (c > -0.5 * k) & (c < k)
        alone = np.divide(ay, aa, out=np.zeros_like(aa), where=aa > 0)
        squares = np.where(fine, total - k * ay - c * by, total - np.maximum(alone, 0.0) * ay)
        better = squares < cost
        cost[better], power[better] = squares[better], exponent
    return cost, power


def _residual(z: Floats, force: Floats, place: float, power: float) -> tuple[Floats, float]:
    depth = np.maximum(place - z, 0.0)
    depth /= float(depth.max()) or 1.0
    matrix = np.column_stack([np.ones_like(z), depth**power, depth ** (power + 1)])
    coefficients = np.linalg.lstsq(matrix, force, rcond=None)[0]
    rise = float(coefficients[1] + coefficients[2])
    return np.asarray(force - matrix @ coefficients), rise


def _inflation(residual: Floats) -> float:
    """Return the ratio of samples to independent samples, from the autocorrelation."""
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if power <= 0:
        return 1.0
    total = 1.0
    for lag in range(1, len(centred) // 4):
        rho = float(centred[:-lag] @ centred[lag:]) / power
        # Further terms would only add noise (Geyer 1992).
        if rho < 2 / np.sqrt(len(centred)):
            break
        total += 2 * rho
    return total


def _interval(
    z: Floats, force: Floats, place: float, limit: float, span: float
) -> tuple[float, float]:
    """Return the outermost heights on either side whose cost is below `limit` [m]."""
    reach = span / 500
    while True:
        grid = np.linspace(place - reach, place + reach, 2 * _FINE + 1)
        cost, _ = _profile(z, force, grid)
        inside = np.flatnonzero(cost <= limit)
        if reach >= span or (inside.size and inside[0] > 0 and inside[-1] < len(grid) - 1):
            break
        reach *= 2
    if not inside.size:
        return (place, place)
    step = float(grid[1] - grid[0])
    return float(grid[inside[0]]) - step, float(grid[inside[-1]]) + step


# The surface by the onset of a sensor's own signal, in and out, so that its delay cancels.
#
# A camera or taxels show a contact late. On the way in, the onset then appears too deep, on the way
# out too high by as much, at the same speed: their mean is the surface.


SIGNAL_METHOD = "onset of the signal, in and out at one speed"
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
    onsets = []
    for way in (down, up):
        order = np.argsort(-way.z, kind="stable")
        z, change = way.z[order], way.change[order]
        kept = z > z.min() + _TURNING if len(z) else np.zeros(0, np.bool_)
        onset = find_onset(z[kept], change[kept]) if kept.sum() >= 20 else None
        if onset is None:
            return None
        onsets.append(onset)
    one, other = onsets
    half = float(np.hypot(*(np.diff(onset.interval)[0] / 4 for onset in onsets)))
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
    groups = {point: [onset for onset, _ in repeats] for point, repeats in approaches.items()}
    first = next(iter(groups))
    heights = {
        point: float(np.mean([each.z for each in repeats])) for point, repeats in groups.items()
    }
    freedom = sum(len(repeats) - 1 for repeats in groups.values())
    squares = sum(
        float(np.sum([(each.z - heights[point]) ** 2 for each in repeats]))
        for point, repeats in groups.items()
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
    delays = [delay for repeats in approaches.values() for _, delay in repeats]
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
    onsets = [each for repeats in groups.values() for each in repeats]
    positions = np.array(
        [places[point] for point, repeats in groups.items() for _ in repeats], np.float64
    )
    sigma = np.array([np.diff(each.interval)[0] / 2 / _SIGMAS_95 for each in onsets])
    matrix = np.column_stack([np.ones(len(onsets)), positions - positions[0]]) / sigma[:, None]
    wanted = np.array([each.z for each in onsets]) / sigma
    plane = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    residual = wanted - matrix @ plane
    freedom = len(onsets) - 3
    excess = max(1.0, float(residual @ residual) / freedom) if freedom else 1.0
    error = float(np.sqrt(excess * np.linalg.inv(matrix.T @ matrix)[0, 0]))
    half = float(np.hypot((student_t(freedom) if freedom else _SIGMAS_95) * error, _MODEL))
    return Surface(float(plane[0]), (float(plane[0]) - half, float(plane[0]) + half), spread)


def touched_by_signal(session: Session, plan: Plan) -> TouchedSurface:
    """Find the surface in a session of touches along `plan`, of a bench without a gauge."""
    approaches: dict[int, list[tuple[Onset, float]]] = {}
    positions: dict[int, Sequence[float]] = {}
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
            both.z - expected, (low - expected, high - expected), both.power, both.force, both.noise
        )
        approaches.setdefault(target.point, []).append((above, delay))
        positions[target.point] = target.origin[:2]
    return surface_of(approaches, positions)


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
