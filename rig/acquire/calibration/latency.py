"""Latency of a camera or taxel pad: its motion during light taps, against force and indentation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.command_line.options import next_command
from recorder.session import EXPOSURE, Session, Stream, captured
from rig.acquire.calibration.onset import student_t
from rig.acquire.calibration.store import require_gauge, stream_of, tip_heights
from rig.bench.bench import Bench
from rig.core.errors import ConfigError, SafetyStop
from rig.devices.camera.jpeg import frame_stamp
from trajectories import Taps

# Lag of a second signal (image, indentation) behind the force in the same taps.
#
# Coarse: the lag of the highest correlation of force and motion, compared with the second highest
# peak; a regular rhythm has many peaks, irregular taps have one. Fine: least squares fit of the
# motion by the lagged force and its square; a parabola through the residuals gives the best lag.
# Interval: bootstrap over taps. Pure functions.
#
# The force of a viscoelastic gel leads its indentation, by some milliseconds for taps of this
# length. The lag of the image behind the indentation is the difference of two lags.

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

# Force is resampled to this interval [s].
STEP = 1e-3
# Force is averaged over this many steps: about a frame's exposure, which reduces noise.
_SMOOTH = 17
# The parabola extends this many steps to both sides of the least residual.
_FIT = 8
# A second peak must be farther than this from the first [s].
_NEIGHBOURHOOD = 0.05
# Smallest and largest lag of the coarse search [s].
_SEARCH = (-0.05, 0.3)
# The fine search extends this far to both sides of the coarse lag [s].
_REACH = 0.03
_ROUNDS = 400


@dataclass(frozen=True, slots=True)
class Lag:
    """Lag of a motion behind the force."""

    value: float
    """Lag of the motion [s]."""
    interval: tuple[float, float]
    """95 % interval, from bootstrap over taps [s]."""
    correlation: float
    """Correlation of force and motion at the coarse lag, -1 to 1."""
    ratio: float
    """Ratio of the highest to the second highest correlation peak; a large value is unambiguous."""
    taps: int
    """Number of taps in the data."""

    @property
    def width(self) -> float:
        """Width of the interval [s]."""
        return self.interval[1] - self.interval[0]


def find_lag(force_t_ns: Times, force: Floats, motion_t_ns: Times, motion: Floats) -> Lag:
    """Find the lag of `motion` behind `force`.

    The magnitude of the force (n,) is about zero without contact [N], the motion (m,) is the
    distance from the state without contact in any unit; their times ascend [ns].
    """
    grid, raster = _rastered(force_t_ns, force)
    seconds = (motion_t_ns - force_t_ns[0]) * 1e-9
    # Keep the samples whose force is known at every lag of the search.
    margin = _REACH + 2 * STEP
    kept = (seconds > grid[0] + _SEARCH[1] + margin) & (seconds < grid[-1] + _SEARCH[0] - margin)
    seconds, motion = seconds[kept], np.asarray(motion, np.float64)[kept]
    if len(seconds) < 30:
        raise ValueError(
            f"motion: found {len(seconds)} samples with force around them; at least 30"
        )
    if not (np.isfinite(raster).all() and np.isfinite(motion).all()):
        raise ValueError("force, motion: values that are not finite")
    if not motion.std() > 0:
        raise ValueError("motion: none differs from the others; does the camera see the gel?")
    taps = _taps(grid, raster)
    if len(taps) < 4:
        raise ValueError(f"force: found {len(taps)} taps; at least 4")
    lags = np.arange(_SEARCH[0], _SEARCH[1] + STEP / 2, STEP)
    curve = np.array([_correlation(np.interp(seconds - lag, grid, raster), motion) for lag in lags])
    coarse = float(lags[curve.argmax()])
    fine = coarse + np.arange(-_REACH, _REACH + STEP / 2, STEP)
    blocks = np.searchsorted((taps[1:] + taps[:-1]) / 2, seconds - coarse)
    squares = _squares(grid, raster, seconds, motion, fine, blocks, len(taps))
    value = _best(fine, squares.sum(axis=1)[None])[0]
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(taps), np.full(len(taps), 1 / len(taps)), _ROUNDS)
    bootstrapped = _best(fine, np.einsum("rb,lbij->rlij", drawn.astype(float), squares))
    # With few taps the bootstrap interval is too narrow.
    widened = student_t(len(taps) - 1) / 1.96
    low, high = value + widened * (np.percentile(bootstrapped, [2.5, 97.5]) - value)
    return Lag(
        float(value),
        (float(low), float(high)),
        float(curve.max()),
        _peak_ratio(lags, curve),
        len(taps),
    )


def _rastered(t_ns: Times, force: Floats) -> tuple[Floats, Floats]:
    """Resample force at intervals of `STEP` from its first sample: times [s] and values."""
    if len(t_ns) < 1000:
        raise ValueError(f"force: found {len(t_ns)} samples; at least 1000")
    seconds = (t_ns - t_ns[0]) * 1e-9
    grid = np.arange(0.0, float(seconds[-1]), STEP)
    values = np.interp(grid, seconds, np.asarray(force, np.float64))
    padded = np.pad(values, _SMOOTH // 2, mode="edge")
    return grid, np.convolve(padded, np.full(_SMOOTH, 1 / _SMOOTH), mode="valid")


def _taps(grid: Floats, force: Floats) -> Floats:
    """Return the midpoints of the intervals above a third of the tapping force (n,) [s]."""
    level = float(np.percentile(force, 98)) / 3
    above = np.concatenate([[False], force > max(level, 1e-12), [False]])
    edges = np.flatnonzero(np.diff(above.astype(np.int8))).reshape(-1, 2)
    longer = edges[edges[:, 1] - edges[:, 0] > 0.02 / STEP]
    return np.asarray(grid[(longer[:, 0] + longer[:, 1] - 1) // 2])


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else 0.0


def _peak_ratio(lags: Floats, curve: Floats) -> float:
    """Return the ratio of the correlation's maximum to its highest local maximum elsewhere."""
    best = int(curve.argmax())
    inner = np.arange(1, len(curve) - 1)
    peaks = inner[(curve[inner] >= curve[inner - 1]) & (curve[inner] >= curve[inner + 1])]
    others = curve[peaks[np.abs(lags[peaks] - lags[best]) > _NEIGHBOURHOOD]]
    second = float(others.max()) if others.size else 0.0
    return float(curve[best] / max(second, 0.01))


def _squares(
    grid: Floats,
    force: Floats,
    seconds: Floats,
    motion: Floats,
    lags: Floats,
    blocks: NDArray[np.intp],
    count: int,
) -> Floats:
    """Return products of [1, force, its square, motion] (lags, blocks, 4, 4)."""
    scale = float(np.abs(force).max()) or 1.0
    level = force / scale
    columns = (level, level**2)
    out = np.empty((len(lags), count, len(columns) + 2, len(columns) + 2))
    picture = motion / (motion.std() or 1.0)
    for number, lag in enumerate(lags):
        shifted = [np.interp(seconds - lag, grid, column) for column in columns]
        rows = np.column_stack([np.ones_like(seconds), *shifted, picture])
        for block in range(count):
            part = rows[blocks == block]
            out[number, block] = part.T @ part
    return out


def _best(lags: Floats, squares: Floats) -> Floats:
    """Return the lag of the least residual (r,) for products (r, lags, k, k), interpolated."""
    inside = squares[..., :-1, :-1]
    ridge = 1e-9 * np.trace(inside, axis1=-2, axis2=-1)[..., None, None] * np.eye(inside.shape[-1])
    cross = squares[..., :-1, -1]
    solved = np.linalg.solve(inside + ridge, cross[..., None])[..., 0]
    cost = squares[..., -1, -1] - np.einsum("...i,...i->...", cross, solved)
    best = np.clip(cost.argmin(axis=-1), _FIT, len(lags) - 1 - _FIT)
    around = np.arange(-_FIT, _FIT + 1)
    near = cost[np.arange(len(cost))[:, None], best[:, None] + around]
    bend, slant, _ = np.polyfit(around, near.T, 2)
    shift = np.divide(-slant, 2 * bend, out=np.zeros_like(bend), where=bend > 0)
    return np.asarray(lags[best] + np.clip(shift, -_FIT, _FIT) * STEP)


METHOD = "taps: motion against force and indentation, bootstrap over taps"
# Widest accepted 95 % interval [s].
WIDTH_MAX = 2e-3
# Least accepted ratio of the highest to the second highest peak.
RATIO_MIN = 1.5
# Force of a tap [N]; its depth follows from the expected force ...
_FORCE = 1.0
# ... but is at most this [m], and at most half of the sensor's depth limit.
_DEEPEST = 1e-3
# Motion of the tip that shows that the arm moves [m], and the least reaction of an arm [s].
_MOVED, _LEAST = 20e-6, 0.02
# Images are compared as means of 8 x 8 pixels, which reduces noise but keeps motion.
_BLOCK = 8
_BATCH = 64


@dataclass(frozen=True, slots=True)
class Latency:
    """Latency of a signal, from a session of taps."""

    stream: str
    """Name of the signal."""
    image: Lag
    """Lag of the signal behind the force."""
    gel: Lag
    """Lag of the indentation (robot's pose) behind the force, from the gel's relaxation."""
    shown: Lag
    """Lag of the signal behind the indentation: without relaxation, and twice as sharp."""
    exposure: float
    """Exposure used by the alignment [s]."""

    @property
    def lag(self) -> float:
        """Time from the indentation to the arrival of the signal that shows it [s]."""
        return self.shown.value

    @property
    def latency(self) -> float:
        """Time from the end of exposure to arrival, subtracted by the alignment [s].

        An image shows the middle of its exposure, half an exposure before its end.
        """
        return self.lag - self.exposure / 2

    @property
    def half(self) -> float:
        """Half of the 95 % interval [s]."""
        return self.shown.width / 2

    @property
    def disagreement(self) -> float:
        """Lag behind the force, minus the gel's lag, minus the lag behind the indentation [s]."""
        return self.image.value - self.gel.value - self.shown.value


def plan_for(bench: Bench, *, depth: float | None, count: int) -> Taps:
    """Return the taps for a bench: about 1 N, at most 1 mm deep."""
    limits = bench.limits
    most = limits.depth_max / 2
    light = min(bench.expected.depth_of(_FORCE)[1], _DEEPEST, most)
    wanted = light if depth is None else depth
    if not 0 < wanted <= limits.depth_max:
        raise ConfigError(
            f"--depth-mm: found {1e3 * wanted:g}; allowed: above 0, up to "
            f"{1e3 * limits.depth_max:g} (limits.depth_max_mm of the bench file)"
        )
    if count < 4:
        raise ConfigError(f"--taps: found {count}; allowed: 4 or more")
    return Taps(depth_max=wanted, count=count)


def signal_of(bench: Bench) -> str:
    """Return the stream whose latency is measured: the bench's signal."""
    require_gauge(bench, "calibrate-latency")
    if bench.signal is None:
        raise ConfigError(
            f"{bench.sensor}: no camera and no taxels; allowed: a stream with the role signal"
        )
    return bench.signal.name


def exposure_of(bench: Bench, stream: str) -> float:
    """Return the exposure that the alignment uses for a stream [s]."""
    stated = getattr(bench.row(stream).config, "exposure", None)
    return EXPOSURE if stated is None else float(stated)


def evaluate(session: Session, stream: str, exposure: float) -> Latency:
    """Find the lag of a stream, with an exposure [s], in a session recorded along `Taps`."""
    force, (moved_ns, height) = stream_of(session, "force"), tip_heights(session)
    pressed = -np.asarray(force.array("value"))[:, 2]
    start = int(session.segments["start_ns"][0])
    signal = session.streams[stream]
    try:
        depth = np.maximum(-height, 0.0)
        times, motion = captured(signal), motion_of(signal, start)
        gel = find_lag(force.t_ns, pressed, moved_ns, depth)
        image = find_lag(force.t_ns, pressed, times, motion)
        behind_depth = find_lag(moved_ns, depth, times, motion)
    except ValueError as error:
        raise SafetyStop(f"calibrate-latency: {error}") from None
    return Latency(stream, image, gel, behind_depth, exposure)


def refusal(found: Latency, *, width_max: float = WIDTH_MAX) -> str | None:
    """Return why to reject a result whose interval may be `width_max` wide [s]; None: accept it."""
    if 2 * found.half > width_max:
        return (
            f"the interval is {2e3 * found.half:.2f} ms wide; allowed: {1e3 * width_max:.1f} ms; "
            "more --taps or a larger --depth-mm narrow it"
        )
    if found.image.ratio < RATIO_MIN:
        return (
            f"the highest peak of the correlation is {found.image.ratio:.2f} times the second; "
            f"allowed: {RATIO_MIN} or more; does the camera see the taps?"
        )
    if abs(found.disagreement) > WIDTH_MAX:
        return (
            f"measured by the force it is {1e3 * found.disagreement:+.2f} ms later than by the "
            f"robot's pose; allowed: {1e3 * WIDTH_MAX:.1f} ms; find the surface first "
            f"({next_command('home')})"
        )
    return None


def motion_of(signal: Stream, start_ns: int) -> Floats:
    """Return samples' distances (n,) from those without contact before `start_ns`, in its unit."""
    before = np.flatnonzero(signal.t_ns < start_ns)
    if not before.size:
        raise ValueError(f"{signal.name}: no sample before the first tap")
    if "value" in signal.small:
        values = np.asarray(signal.array("value"), np.float64).reshape(len(signal), -1)
    else:
        values = np.concatenate(
            [
                _blocks(signal.images(np.arange(first, min(first + _BATCH, len(signal)))))
                for first in range(0, len(signal), _BATCH)
            ]
        )
    still = values[before[-min(len(before), 30) :]].mean(axis=0)
    return np.asarray(np.abs(values - still).mean(axis=1))


def _blocks(images: NDArray[np.uint8]) -> Floats:
    """Return means over blocks of pixels and colours (n, blocks) of images (n, h, w, 3)."""
    count, height, width = images.shape[:3]
    rows, columns = height // _BLOCK, width // _BLOCK
    cut = images[:, : rows * _BLOCK, : columns * _BLOCK].reshape(count, rows, _BLOCK, columns, -1)
    return np.asarray(cut.mean(axis=(2, 4), dtype=np.float32), np.float64).reshape(count, -1)


def true_lag(session: Session, stream: str = "camera") -> float | None:
    """Return the mean time from the state shown in an emulated camera's images to arrival [s].

    Only images that show contact count; they take the emulator longer to draw.
    """
    camera, (moved_ns, height) = session.streams[stream], tip_heights(session)
    late = []
    for row, t_ns in enumerate(camera.t_ns):
        stamp = frame_stamp(camera.jpeg(row) or b"")
        if stamp is None:
            continue
        at = int(np.searchsorted(moved_ns, stamp[1]))
        if at < len(height) and height[at] < 0:
            late.append((int(t_ns) - stamp[1]) * 1e-9)
    return float(np.mean(late)) if late else None


def reaction_of(session: Session, bench: Bench) -> float:
    """Return the longest time in which the arm answered a command of a session, and stops [s].

    It answers a guard as it answers a command. The time that it takes from rest to move by `_MOVED`
    is subtracted, that to stop from the bench's speed added.
    """
    moved_ns, height = tip_heights(session)
    late, arm = [], bench.arm
    for start, end in zip(session.segments["start_ns"], session.segments["end_ns"], strict=True):
        rows = np.flatnonzero((moved_ns >= start) & (moved_ns <= end))
        moved = rows[np.abs(height[rows] - height[rows[:1]]) > _MOVED]
        late += [(int(moved_ns[row]) - int(start)) * 1e-9 for row in moved[:1]]
    answered = max(late, default=0.0) - float(np.sqrt(2 * _MOVED / arm.acceleration))
    return max(answered, _LEAST) + arm.speed / arm.stop_deceleration


def lines_of(found: Latency, session: Session) -> list[str]:
    """Return the result as lines; on a mock bench with the emulator's timestamps."""
    low, high = (1e3 * (found.lag + sign * found.half) for sign in (-1, 1))
    lines = [
        f"{found.stream} lags the indentation by {1e3 * found.lag:.2f} ms (95 % {low:.2f} to "
        f"{high:.2f} ms), {found.image.taps} taps",
        f"{found.stream} lags the force by {1e3 * found.image.value:.2f} ms, correlation "
        f"{found.image.correlation:.3f}, peak ratio {found.image.ratio:.1f}; the gel lags it by "
        f"{1e3 * found.gel.value:.2f} ms: the two ways differ by "
        f"{1e3 * found.disagreement:+.2f} ms",
        f"latency {1e3 * found.latency:.2f} ms from the end of a {1e3 * found.exposure:.1f} ms "
        "exposure: subtracted by the alignment",
    ]
    kind = session.streams[found.stream].traits.kind
    drawn = kind == "camera" and session.attrs["mock"]
    truth = true_lag(session, found.stream) if drawn else None
    if truth is not None:
        lines.append(
            f"by the emulator's timestamps it is {1e3 * truth:.2f} ms: "
            f"difference {1e3 * (found.lag - truth):+.2f} ms"
        )
    if session.streams[found.stream].traits.clock == "monotonic":
        lines.append("its driver timestamps captures itself: alignment uses those, not this")
    return lines
