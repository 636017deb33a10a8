"""How late a camera (or a taxel pad) is: light taps, its motion against force and indentation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder import Session, Stream
from recorder.session.align import EXPOSURE, captured
from rig.arm.rotation import invert, transform
from rig.bench import Bench
from rig.calibrate.lag import Lag, find_lag
from rig.camera.jpeg import frame_stamp
from rig.errors import ConfigError, SafetyStop
from trajectories import Taps

Floats = NDArray[np.float64]

METHOD = "taps: motion against force and indentation, bootstrap over taps"
WIDTH_MAX = 2e-3
"""A wider 95 % interval is refused [s]."""
RATIO_MIN = 1.5
"""A second peak nearer to the first than this is refused."""
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
