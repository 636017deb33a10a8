"""Part 6: time of each alignment method, and its error compared with the ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.measure import Scale, cpu_seconds
from benchmarks.recording.motion import (
    EXPOSURE,
    LATENCY,
    VIEW_HZ,
    Motion,
    Recorded,
    record_motion,
    ticks,
)
from benchmarks.recording.steps import Steps
from recorder import Session, Window
from recorder.session import align
from recorder.session.align import Sources, align_window
from recorder.session.reader import ticks_before
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.geometry import rotation_between

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

WINDOW = 16
FORCE = ("latest", "nearest", "interpolated", "mean")
POSE = ("latest", "nearest", "interpolated")
IMAGE = ("latest", "nearest")
# Camera latencies that are left uncalibrated [s].
UNCORRECTED = (0.008, 0.055)
_REPEATS = 200
_WINDOWS_SECONDS = 1.0


@dataclass(frozen=True, slots=True)
class Error:
    """Errors of one quantity over all valid rows."""

    rms: float
    most: float

    @classmethod
    def of(cls, values: Floats) -> Error:
        """Return the error of magnitudes (n,), or NaN if there are none."""
        if not len(values):
            return cls(float("nan"), float("nan"))
        return cls(float(np.sqrt(np.mean(values**2))), float(values.max()))


@dataclass(frozen=True, slots=True)
class Method:
    """One method of aligning one stream."""

    stream: str
    method: str
    rows: int
    """Number of valid rows it was computed from."""
    errors: dict[str, Error]
    """Errors by unit: N, mm, deg or px."""
    per_window: float
    """Time for a window of 16 rows of this stream alone, images not decoded [s]."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Effect of a camera's latency on the labels."""

    uncorrected: float
    """Latency that the session does not know [s]; 0 for a calibrated camera."""
    force: Error
    """Error of the best force method [N]."""
    position: Error
    """Position error of the best pose method [mm]."""
    angle: Error
    """Angle error of the best pose method [deg]."""
    marker: Error
    """Shift of the fastest marker between assumed and true capture [px]."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """All results of part 6."""

    methods: tuple[Method, ...]
    latencies: tuple[Latency, ...]
    windows: float
    """`Session.window` of 16 rows with decoded images and all streams [s]."""
    windows_align: float
    """The same without images [s]."""
    window_images: float
    """Images per second of CPU time of `Session.window`."""
    stream_images: float
    """Images per second of CPU time of `Stream.images` for the same rows."""
    mock: tuple[Method, ...] = ()
    """Results on a session from the mock bench, compared with its World's ground truth."""
    mock_missing: str = ""
    """Reason for a missing mock session."""


def estimate(scale: Scale) -> float:
    """Return the expected duration of `alignment` [s]."""
    return 0.25 * scale.alignment + 4.0 + _WINDOWS_SECONDS + _mock_seconds(scale)


def alignment(
    scale: Scale, place: Path, steps: Steps, collect: Callable[[int, Path], tuple[Path, Path]]
) -> Alignment:
    """Measure errors and times of all methods.

    Args:
        scale: Durations of the measurements.
        place: Folder for sessions.
        steps: Display of the current step.
        collect: Collects a number of targets on the mock bench; returns session and ground truth.
    """
    steps.step("alignment: a motion with known ground truth", 0.2 * scale.alignment + 2.0)
    motion = Motion(scale.alignment)
    recorded = record_motion(motion, scale.alignment, place / "motion.zarr")
    session = Session(recorded.path)
    steps.step("alignment: methods", 0.05 * scale.alignment + 2.0 + _WINDOWS_SECONDS)
    methods = measure_methods(session, motion, recorded)
    latencies = tuple(
        measure_latency(session, motion, recorded, late) for late in (0.0, *UNCORRECTED)
    )
    windows = _time_windows(session, recorded)
    mock: tuple[Method, ...] = ()
    missing = "skipped in quick runs"
    if scale.targets:
        from benchmarks.recording.mock_session import compare_mock

        steps.step("alignment: a session on the mock bench", _mock_seconds(scale))
        mock, missing = compare_mock(collect, scale.targets, place)
    return Alignment(methods, latencies, *windows, mock, missing)


def measure_methods(session: Session, motion: Motion, recorded: Recorded) -> tuple[Method, ...]:
    """Measure every method of every stream."""
    sources, when = session.sources(0), ticks(recorded)
    found = []
    for method in FORCE:
        window = align_window(when, sources, {"force": method})
        error = force_error(window, motion, recorded)
        found.append(_method("force", method, error, _alone(sources, "force"), {"force": method}))
    found.append(_read_with_frame(when, sources, motion, recorded))
    for method in POSE:
        window = align_window(when, sources, {"pose": method})
        error = pose_errors(window, window.pose, motion, recorded)
        found.append(_method("pose", method, error, _alone(sources, "pose"), {"pose": method}))
    found.append(_componentwise(when, sources, motion, recorded))
    for method in IMAGE:
        window = align_window(when, sources, {"camera": method})
        shown = image_error(window, motion, recorded)
        found.append(_method("image", method, shown, _alone(sources, ""), {"camera": method}))
    return tuple(found)


def measure_latency(
    session: Session, motion: Motion, recorded: Recorded, uncorrected: float
) -> Latency:
    """Measure the best methods when the session ignores `uncorrected` seconds of latency."""
    sources = session.sources(0)
    camera = sources.signal
    if camera is not None and uncorrected:
        # The session subtracts LATENCY; it does not know the extra delay of the camera.
        late = replace(camera, times=camera.times + round(uncorrected * 1e9))
        sources = replace(sources, streams={**sources.streams, late.name: late}, signal=late)
    window = align_window(ticks(recorded), sources)
    pose = pose_errors(window, window.pose, motion, recorded)
    true, rows = _true_capture(window, recorded)
    believed = (window.capture_ns[rows] - recorded.origin_ns) / SECOND_NS
    return Latency(
        uncorrected,
        Error.of(force_error(window, motion, recorded)["N"]),
        Error.of(pose["mm"]),
        Error.of(pose["deg"]),
        Error.of(_marker_motion(motion, believed, true)),
    )


def force_error(window: Window, motion: Motion, recorded: Recorded) -> dict[str, Floats]:
    """Return the distance (n,) from the mean true force over the true exposure [N]."""
    true, rows = _true_capture(window, recorded)
    wrench = window.of("wrench")
    if wrench is None or wrench.value is None:
        return {"N": np.zeros(0)}
    truth = motion.mean_wrench(true - EXPOSURE, true)
    off = np.linalg.norm(wrench.value[rows, :3] - truth[:, :3], axis=1)
    return {"N": off[wrench.valid[rows]]}


def pose_errors(
    window: Window, poses: Floats | None, motion: Motion, recorded: Recorded
) -> dict[str, Floats]:
    """Return distance [mm] and angle [deg] (n,) from the true pose at the true capture."""
    true, rows = _true_capture(window, recorded)
    pose = window.of("pose")
    if poses is None or pose is None:
        return {"mm": np.zeros(0), "deg": np.zeros(0)}
    truth, valid = motion.pose(true), pose.valid[rows]
    off = 1e3 * np.linalg.norm(poses[rows, :3] - truth[:, :3], axis=1)
    angle = np.degrees(np.linalg.norm(rotation_between(truth, poses[rows]), axis=1))
    return {"mm": off[valid], "deg": angle[valid]}


def image_error(window: Window, motion: Motion, recorded: Recorded) -> dict[str, Floats]:
    """Return the motion of the fastest marker between the image's capture and the tick [px]."""
    true, rows = _true_capture(window, recorded)
    tick = (window.t_ns[rows] - recorded.origin_ns) / SECOND_NS
    return {"px": _marker_motion(motion, tick, true)}


def _true_capture(window: Window, recorded: Recorded) -> tuple[Floats, NDArray[np.intp]]:
    """Return the true capture [s] of the rows that have an image, and those rows."""
    rows = np.flatnonzero(window.signal_row >= 0)
    return recorded.captured[window.signal_row[rows]], rows


def _marker_motion(motion: Motion, first: Floats, second: Floats) -> Floats:
    apart = np.linalg.norm(motion.pixels(first) - motion.pixels(second), axis=2)
    return np.asarray(apart.max(axis=1))


def _read_with_frame(when: Times, sources: Sources, motion: Motion, recorded: Recorded) -> Method:
    """Measure a loop that reads the force once, whenever a frame has arrived."""
    name, force = "read with the frame", sources.streams.get("force")
    window = align_window(when, sources)
    if force is None or force.values is None or window.wrench is None:
        return Method("force", name, 0, {}, float("nan"))
    late, times, values = round(LATENCY * 1e9), force.times, force.values

    def once(some: Times) -> Floats:
        return np.asarray(values[align.held(times, some + late).index])

    read = replace(window.streams[force.name], value=once(window.capture_ns))
    streams = {**window.streams, force.name: read}
    error = force_error(replace(window, streams=streams), motion, recorded)
    errors = {"N": Error.of(error["N"])}
    return Method("force", name, len(error["N"]), errors, _timed(sources, once))


def _componentwise(when: Times, sources: Sources, motion: Motion, recorded: Recorded) -> Method:
    """Measure the naive method that interpolates the pose's six numbers separately."""
    pose = sources.streams.get("pose")
    window = align_window(when, sources)
    if pose is None or pose.values is None:
        return Method("pose", "component-wise linear", 0, {}, float("nan"))
    linear = align.linear(pose.times, pose.values, window.capture_ns, max_age=pose.max_age)
    error = pose_errors(window, linear.value, motion, recorded)

    values, times = pose.values, pose.times

    def once(some: Times) -> None:
        align.linear(times, values, some, max_age=pose.max_age)

    rows = len(error["mm"])
    errors = {unit: Error.of(values) for unit, values in error.items()}
    return Method("pose", "component-wise linear", rows, errors, _timed(sources, once))


def _alone(sources: Sources, name: str) -> Sources:
    """Return only the signal and one other stream."""
    kept = {key: one for key, one in sources.streams.items() if key in (name, "camera")}
    return replace(sources, streams=kept)


def _method(
    stream: str, method: str, error: dict[str, Floats], sources: Sources, chosen: dict[str, str]
) -> Method:
    def once(some: Times) -> None:
        align_window(some, sources, chosen)

    rows = min(len(values) for values in error.values())
    errors = {unit: Error.of(values) for unit, values in error.items()}
    return Method(stream, method, rows, errors, _timed(sources, once))


def _timed(sources: Sources, once: Callable[[Times], object]) -> float:
    """Return the median time of `once` over windows at random places [s]."""
    span = sources.span or (0, 0)
    clock, rng = SystemClock(), np.random.default_rng(0)
    took = []
    for end in rng.integers(span[0] + SECOND_NS, span[1], _REPEATS).tolist():
        some = ticks_before(end, WINDOW, VIEW_HZ)
        before = clock.now_ns()
        once(some)
        took.append(clock.now_ns() - before)
    return float(np.median(took)) * 1e-9


def _time_windows(session: Session, recorded: Recorded) -> tuple[float, float, float, float]:
    """Return the times of `Session.window` with images, of its alignment alone [s], and rates.

    The rates are images per second of CPU time, of `Session.window` and of `Stream.images`.
    """
    clock, rng, when = SystemClock(), np.random.default_rng(0), ticks(recorded)
    sources = session.sources(0)
    aligned = _timed(sources, lambda some: align_window(some, sources))
    camera, when = session.streams["camera"], when[2 * WINDOW :]
    done, took, cpu, cpu_images = 0, 0, 0.0, 0.0
    while took < _WINDOWS_SECONDS * SECOND_NS:
        # Alternating, so that both see the same state of the machine.
        start, before = clock.now_ns(), cpu_seconds()
        window = session.window(int(rng.choice(when)), WINDOW)
        took += clock.now_ns() - start
        read_at = cpu_seconds()
        camera.images(window.signal_row)
        cpu, cpu_images = cpu + read_at - before, cpu_images + cpu_seconds() - read_at
        done += 1
    images = done * WINDOW
    return took / SECOND_NS / done, aligned, images / cpu, images / cpu_images


def _mock_seconds(scale: Scale) -> float:
    return 25.0 + 4.0 * scale.targets if scale.targets else 0.0
