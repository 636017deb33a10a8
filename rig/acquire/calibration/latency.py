"""How late a camera (or a taxel pad) is: light taps, its motion against force and indentation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder import Session, Stream
from recorder.session import EXPOSURE, captured
from rig.bench.bench import Bench
from rig.core.errors import ConfigError, SafetyStop
from rig.core.geometry import invert, transform
from rig.devices.camera.jpeg import frame_stamp
from trajectories import Taps

# How much later than the force something else shows the same tap: an image, the indentation.
#
# Coarse: the correlation of force and motion over lags, with its highest and second highest peak; a
# regular rhythm has many, irregular taps have one. Fine: force at the times of the motion less the
# lag, and its square, explain the motion best at one lag; least squares, and a parabola through the
# residuals about it. Interval: bootstrap over taps. Pure functions.
#
# A viscoelastic gel's force runs ahead of its indentation, by some milliseconds for taps of this
# length. Whoever wants the image against the indentation takes the difference of two lags.

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

# Force is brought to this raster [s].
STEP = 1e-3
_SMOOTH = 17
# Force is averaged over so many steps: a frame's exposure, and its noise is left behind.
_FIT = 8
# The parabola goes through so many steps to both sides of the least residual.
_NEIGHBOURHOOD = 0.05
# A second peak is one outside this distance from the first [s].
_REACH = 0.03
# The fine search looks so far to both sides of the coarse one [s].
_ROUNDS = 400
_T_95 = (12.71, 12.71, 12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18)
# Student's t for 95 % from 0 to 13 taps; beyond, 2.1. A bootstrap of few taps is too narrow by it.


@dataclass(frozen=True, slots=True)
class Lag:
    """How late a motion is."""

    value: float
    """Motion after force [s]."""
    interval: tuple[float, float]
    """95 % interval, from bootstrap over taps [s]."""
    correlation: float
    """Of force and motion at the coarse lag, -1 to 1."""
    ratio: float
    """Highest over second highest peak of the correlation; large is unambiguous."""
    taps: int
    """Taps it was found from."""

    @property
    def width(self) -> float:
        """Width of the interval [s]."""
        return self.interval[1] - self.interval[0]


def find_lag(
    force_t_ns: Times,
    force: Floats,
    motion_t_ns: Times,
    motion: Floats,
    *,
    search: tuple[float, float] = (-0.05, 0.3),
    seed: int = 0,
) -> Lag:
    """Find by how much `motion` lags behind `force`.

    Args:
        force_t_ns: Times of the force (n,) [ns], ascending.
        force: Size of the force (n,) [N]; about zero without contact.
        motion_t_ns: Times of the motion (m,) [ns], ascending.
        motion: How far each is from the untouched state (m,), any unit.
        search: Smallest and largest lag looked for [s].
        seed: Of the bootstrap.

    Raises:
        ValueError: Too few samples, no taps, or nothing that moves.
    """
    grid, raster = _rastered(force_t_ns, force)
    seconds = (motion_t_ns - force_t_ns[0]) * 1e-9
    # Samples whose force is known at every lag that is tried.
    margin = _REACH + 2 * STEP
    kept = (seconds > grid[0] + search[1] + margin) & (seconds < grid[-1] + search[0] - margin)
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
    lags = np.arange(search[0], search[1] + STEP / 2, STEP)
    curve = np.array([_correlation(np.interp(seconds - lag, grid, raster), motion) for lag in lags])
    coarse = float(lags[curve.argmax()])
    fine = coarse + np.arange(-_REACH, _REACH + STEP / 2, STEP)
    blocks = np.searchsorted((taps[1:] + taps[:-1]) / 2, seconds - coarse)
    squares = _squares(grid, raster, seconds, motion, fine, blocks, len(taps))
    value = _best(fine, squares.sum(axis=1)[None])[0]
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(len(taps), np.full(len(taps), 1 / len(taps)), _ROUNDS)
    found = _best(fine, np.einsum("rb,lbij->rlij", drawn.astype(float), squares))
    widened = (_T_95[len(taps)] if len(taps) < len(_T_95) else 2.1) / 1.96
    low, high = value + widened * (np.percentile(found, [2.5, 97.5]) - value)
    return Lag(
        float(value),
        (float(low), float(high)),
        float(curve.max()),
        _peak_ratio(lags, curve),
        len(taps),
    )


def _rastered(t_ns: Times, force: Floats) -> tuple[Floats, Floats]:
    """Force on a raster of `STEP` from its first sample on: times [s] and values."""
    if len(t_ns) < 1000:
        raise ValueError(f"force: found {len(t_ns)} samples; at least 1000")
    seconds = (t_ns - t_ns[0]) * 1e-9
    grid = np.arange(0.0, float(seconds[-1]), STEP)
    values = np.interp(grid, seconds, np.asarray(force, np.float64))
    padded = np.pad(values, _SMOOTH // 2, mode="edge")
    return grid, np.convolve(padded, np.full(_SMOOTH, 1 / _SMOOTH), mode="valid")


def _taps(grid: Floats, force: Floats) -> Floats:
    """Middles of the stretches above a third of the tapping force (n,) [s]."""
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
    """Highest value of the correlation over its highest local maximum elsewhere."""
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
    """Products of [1, force, its square, motion] (lags, blocks, 4, 4)."""
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
    """Lag of the least residual (r,) for products (r, lags, k, k), between the raster's points."""
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
# A wider 95 % interval is refused [s].
WIDTH_MAX = 2e-3
# A second peak nearer to the first than this is refused.
RATIO_MIN = 1.5
_FORCE = 1.0
# A tap is as deep as this force goes by the bench file's stiffness [N] ...
_DEEPEST = 1e-3
# ... but no deeper than this [m], and than half of what the sensor stands.
_BLOCK = 8
# Images are compared as means of 8 x 8 pixels: noise is left behind, motion is not.
_BATCH = 64


@dataclass(frozen=True, slots=True)
class Latency:
    """What a session of taps says of its signal."""

    stream: str
    """The signal."""
    image: Lag
    """The signal after the force."""
    gel: Lag
    """The indentation (robot's pose) after the force: what the gel's relaxation makes of it."""
    shown: Lag
    """The signal after the indentation: free of that, and twice as sharp."""
    exposure: float
    """Exposure that alignment will use [s]."""

    @property
    def lag(self) -> float:
        """From the indentation to the arrival of the signal that shows it [s]."""
        return self.shown.value

    @property
    def latency(self) -> float:
        """From the end of the exposure to the arrival: what alignment takes off [s].

        A picture shows the middle of its exposure, half an exposure before its end.
        """
        return self.lag - self.exposure / 2

    @property
    def half(self) -> float:
        """Half of the 95 % interval [s]."""
        return self.shown.width / 2

    @property
    def disagreement(self) -> float:
        """Lag after the force, less the gel's, minus that after the indentation [s]."""
        return self.image.value - self.gel.value - self.shown.value


def plan_for(bench: Bench, *, depth: float | None, count: int) -> Taps:
    """The taps for a bench: about 1 N, at most 1 mm.

    Raises:
        ConfigError: Too deep for the sensor, or fewer than 4 taps.
    """
    limits = bench.limits
    most = limits.depth_max / 2
    light = min(_FORCE / limits.stiffness, _DEEPEST, most)
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
    """The stream whose latency is measured: the camera, or else the taxels."""
    return "camera" if bench.camera is not None else "taxels"


def exposure_of(bench: Bench, stream: str) -> float:
    """The exposure that alignment uses for a stream [s]."""
    stated = bench.camera.exposure if stream == "camera" and bench.camera is not None else None
    return EXPOSURE if stated is None else float(stated)


def evaluate(session: Session, stream: str, exposure: float) -> Latency:
    """Find the lag of a stream in a recorded session of taps.

    Args:
        session: Recorded along `Taps`.
        stream: `camera` or `taxels`.
        exposure: See `exposure_of` [s].

    Raises:
        SafetyStop: Nothing was felt or seen: the bench is not as its file says.
    """
    force, pose = session.streams["force"], session.streams["pose"]
    pressed = -np.asarray(force.array("value"))[:, 2]
    frame = invert(session.attrs["contact_frame"])
    height = transform(frame, np.asarray(pose.array("value"))[:, :3])[:, 2]
    start = int(session.segments["start_ns"][0])
    signal = session.streams[stream]
    try:
        depth = np.maximum(-height, 0.0)
        times, motion = captured(signal), motion_of(signal, start)
        gel = find_lag(force.t_ns, pressed, pose.t_ns, depth)
        image = find_lag(force.t_ns, pressed, times, motion)
        shown = find_lag(pose.t_ns, depth, times, motion)
    except ValueError as error:
        raise SafetyStop(f"calibrate-latency: {error}") from None
    return Latency(stream, image, gel, shown, exposure)


def refusal(found: Latency) -> str | None:
    """Why a result must not be used, with the number, or None."""
    if 2 * found.half > WIDTH_MAX:
        return (
            f"the interval is {2e3 * found.half:.2f} ms wide; allowed: {1e3 * WIDTH_MAX:.1f} ms; "
            "more --taps or a larger --depth-mm narrow it"
        )
    if found.image.ratio < RATIO_MIN:
        return (
            f"the highest peak of the correlation is {found.image.ratio:.2f} times the second; "
            f"allowed: {RATIO_MIN} or more; does the camera see the taps?"
        )
    if abs(found.disagreement) > WIDTH_MAX:
        return (
            f"by the force it is {1e3 * found.disagreement:+.2f} ms later than by the robot's "
            f"pose; allowed: {1e3 * WIDTH_MAX:.1f} ms; find the surface first (make home)"
        )
    return None


def motion_of(signal: Stream, start_ns: int) -> Floats:
    """How far each sample is from the untouched ones before `start_ns` (n,), in its own unit.

    Raises:
        ValueError: No sample before `start_ns`.
    """
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
    """Means of blocks of pixels, colours together (n, blocks), of images (n, h, w, 3)."""
    count, height, width = images.shape[:3]
    rows, columns = height // _BLOCK, width // _BLOCK
    cut = images[:, : rows * _BLOCK, : columns * _BLOCK].reshape(count, rows, _BLOCK, columns, -1)
    return np.asarray(cut.mean(axis=(2, 4), dtype=np.float32), np.float64).reshape(count, -1)


def true_lag(session: Session) -> float | None:
    """From the moment an emulated camera's images of taps show to their arrival, mean [s].

    Only those that show contact count: they take the emulator longer to draw.
    """
    camera, pose = session.streams["camera"], session.streams["pose"]
    frame = invert(session.attrs["contact_frame"])
    height = transform(frame, np.asarray(pose.array("value"))[:, :3])[:, 2]
    late = []
    for row, t_ns in enumerate(camera.t_ns):
        stamp = frame_stamp(camera.jpeg(row) or b"")
        if stamp is None:
            continue
        at = int(np.searchsorted(pose.t_ns, stamp[1]))
        if at < len(height) and height[at] < 0:
            late.append((int(t_ns) - stamp[1]) * 1e-9)
    return float(np.mean(late)) if late else None


def lines_of(found: Latency, session: Session) -> list[str]:
    """What is printed of it; on a mock bench beside what the emulator's stamps say."""
    low, high = (1e3 * (found.lag + sign * found.half) for sign in (-1, 1))
    lines = [
        f"{found.stream} lags the indentation by {1e3 * found.lag:.2f} ms (95 % {low:.2f} to "
        f"{high:.2f} ms), {found.image.taps} taps",
        f"{found.stream} lags the force by {1e3 * found.image.value:.2f} ms, correlation "
        f"{found.image.correlation:.3f}, peak ratio {found.image.ratio:.1f}; the gel lags it by "
        f"{1e3 * found.gel.value:.2f} ms: the two ways differ by "
        f"{1e3 * found.disagreement:+.2f} ms",
        f"latency {1e3 * found.latency:.2f} ms from the end of a {1e3 * found.exposure:.1f} ms "
        "exposure: what alignment takes off",
    ]
    truth = true_lag(session) if found.stream == "camera" and session.attrs["mock"] else None
    if truth is not None:
        lines.append(
            f"the emulator's stamps say {1e3 * truth:.2f} ms: "
            f"difference {1e3 * (found.lag - truth):+.2f} ms"
        )
    if session.streams[found.stream].attrs.get("device_clock") == "monotonic":
        lines.append("its driver stamps the capture itself: alignment uses that, not this")
    return lines
