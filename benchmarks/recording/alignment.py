"""Part `alignment`: error of each alignment method compared with the truth, and its time."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording import motion as known
from benchmarks.recording.measure import WINDOW
from benchmarks.recording.motion import EXPOSURE, LATENCY, Motion, Recorded, record_motion, ticks
from benchmarks.report import Page, Run, table
from recorder import Session, Window
from recorder.charts import chart
from recorder.session import align
from recorder.session.align import Sources, align_window
from recorder.session.reader import ticks_before
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.geometry import rotation_between

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

METHODS = {
    "force": ("latest", "nearest", "interpolated", "mean"),
    "pose": ("latest", "nearest", "interpolated"),
    "camera": ("latest", "nearest"),
}
# The default of each stream, and the unit in which it must be as accurate as any, to 5 %.
DEFAULTS = {"force": ("mean", "N"), "pose": ("interpolated", "deg")}
# Camera latencies that are left uncalibrated [s].
UNCORRECTED = (0.0, 0.008, 0.055)
_REPEATS = 200


def measure(run: Run) -> dict[str, Any]:
    """Measure errors and times of all methods on a motion with known ground truth."""
    seconds = 3.0 if run.quick else 30.0
    motion = Motion(seconds)
    recorded = record_motion(motion, seconds, run.folder / "motion.zarr")
    session = Session(recorded.path)
    run.progress(0.6)
    methods = measure_methods(session, motion, recorded)
    latencies = [measure_latency(session, motion, recorded, late) for late in UNCORRECTED]
    run.progress(0.9)
    run.seeds = [0]
    values = {"methods": methods, "latencies": latencies}
    run.failures += [
        f"{goal}: {figures}" for goal, figures, reached in goals(values) if not reached
    ]
    return values


def goals(values: dict[str, Any]) -> list[tuple[str, str, bool]]:
    """Return each goal of the errors, the values, and whether they reach it."""
    lines = []
    for stream, (default, unit) in DEFAULTS.items():
        methods = [one for one in values["methods"] if one["stream"] == stream]
        errors = {one["method"]: one[unit]["rms"] for one in methods}
        best = min(errors, key=lambda method: errors[method])
        figures = f"{errors[default]:.3g} {unit} rms; best: {best}, {errors[best]:.3g} {unit}"
        goal = f"the default for {stream} (`{default}`) is as accurate as any"
        lines.append((goal, figures, errors[default] <= 1.05 * errors[best]))
    return lines


def rms_and_most(values: Floats) -> dict[str, float]:
    """Return the error of magnitudes (n,), or NaN if there are none."""
    if not len(values):
        return {"rms": math.nan, "most": math.nan}
    return {"rms": float(np.sqrt(np.mean(values**2))), "most": float(values.max())}


def measure_methods(session: Session, motion: Motion, recorded: Recorded) -> list[dict[str, Any]]:
    """Measure every method of every stream: errors by unit, and us for a window of that stream."""
    sources, when = session.sources(0), ticks(recorded)
    of_stream = {"force": force_error, "pose": pose_errors, "camera": image_error}
    rows = []
    for stream, methods in METHODS.items():
        streams = {k: one for k, one in sources.streams.items() if k in (stream, "camera")}
        alone = replace(sources, streams=streams)
        for method in methods:
            window = align_window(when, sources, {stream: method})
            errors = of_stream[stream](window, motion, recorded)
            once = partial(align_window, sources=alone, methods={stream: method})
            rows.append(_method(stream, method, errors, _timed(sources, once)))
    return [*rows, *_naive(when, sources, motion, recorded)]


def _naive(
    when: Times, sources: Sources, motion: Motion, recorded: Recorded
) -> list[dict[str, Any]]:
    """Measure a loop that reads the force with the frame, and poses interpolated by component."""
    window, late = align_window(when, sources), round(LATENCY * 1e9)
    force, pose = sources.streams["force"], sources.streams["pose"]
    wrenches, poses = np.asarray(force.values), np.asarray(pose.values)

    def read(some: Times) -> Floats:
        return np.asarray(wrenches[align.held(force.times, some + late).index])

    def by_component(some: Times) -> Floats:
        return np.asarray(align.linear(pose.times, poses, some, max_age=pose.max_age).value)

    rows = []
    for name, method, values, errors_of in (
        ("force", "read with the frame", read, force_error),
        ("pose", "by component", by_component, pose_errors),
    ):
        part = replace(window.streams[name], value=values(window.capture_ns))
        other = replace(window, streams={**window.streams, name: part})
        errors = errors_of(other, motion, recorded)
        rows.append(_method(name, method, errors, _timed(sources, values)))
    return rows


def _method(
    stream: str, method: str, errors: dict[str, Floats], window_us: float
) -> dict[str, Any]:
    rows = min(len(values) for values in errors.values())
    about = {"stream": stream, "method": method, "rows": rows, "window_us": window_us}
    return about | {unit: rms_and_most(values) for unit, values in errors.items()}


def measure_latency(
    session: Session, motion: Motion, recorded: Recorded, uncorrected: float
) -> dict[str, Any]:
    """Measure the best methods when the session ignores `uncorrected` seconds of latency."""
    sources = session.sources(0)
    camera = sources.signal
    if camera is not None and uncorrected:
        # The session subtracts LATENCY; it does not know the extra delay of the camera.
        late = replace(camera, times=camera.times + round(uncorrected * 1e9))
        sources = replace(sources, streams={**sources.streams, late.name: late}, signal=late)
    window = align_window(ticks(recorded), sources)
    true, rows = _true_capture(window, recorded)
    believed = (window.capture_ns[rows] - recorded.origin_ns) / SECOND_NS
    errors = force_error(window, motion, recorded) | pose_errors(window, motion, recorded)
    errors["px"] = _marker_motion(motion, believed, true)
    return {"uncorrected": uncorrected} | {unit: rms_and_most(errors[unit]) for unit in errors}


def force_error(window: Window, motion: Motion, recorded: Recorded) -> dict[str, Floats]:
    """Return the distance (n,) from the mean true force over the true exposure [N]."""
    true, rows = _true_capture(window, recorded)
    wrench = window.streams["force"]
    truth = motion.mean_wrench(true - EXPOSURE, true)
    off = np.linalg.norm(np.asarray(wrench.value)[rows, :3] - truth[:, :3], axis=1)
    return {"N": off[wrench.valid[rows]]}


def pose_errors(window: Window, motion: Motion, recorded: Recorded) -> dict[str, Floats]:
    """Return distance [mm] and angle [deg] (n,) from the true pose at the true capture."""
    true, rows = _true_capture(window, recorded)
    pose = window.streams["pose"]
    truth, valid, value = motion.pose(true), pose.valid[rows], np.asarray(pose.value)[rows]
    off = 1e3 * np.linalg.norm(value[:, :3] - truth[:, :3], axis=1)
    angle = np.degrees(np.linalg.norm(rotation_between(truth, value), axis=1))
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


def _timed(sources: Sources, once: Callable[[Times], object]) -> float:
    """Return the median time of `once` over windows at random places [us]."""
    every = [each.times for each in sources.streams.values() if each.traits.roles]
    span = min(int(each[0]) for each in every), max(int(each[-1]) for each in every)
    clock, rng = SystemClock(), np.random.default_rng(0)
    took = []
    for end in rng.integers(span[0] + SECOND_NS, span[1], _REPEATS).tolist():
        some = ticks_before(end, WINDOW, known.VIEW_HZ)
        before = clock.now_ns()
        once(some)
        took.append(clock.now_ns() - before)
    return float(np.median(took)) * 1e-3


_ABOUT = f"""\
A motion with known truth: {known.PRESS_HZ:g} presses a second up to {known.PEAK:g} N with shear and
a tilting tool. Camera {known.FRAME_HZ:g} Hz with an exposure of {1e3 * EXPOSURE:g} ms and a
calibrated latency of {1e3 * LATENCY:g} ms, force {known.FORCE_HZ:g} Hz with noise of
{known.FORCE_NOISE:g} N, pose {known.POSE_HZ:g} Hz, arrivals with jitter; rows at {known.VIEW_HZ:g}
Hz. Force is compared with the true mean over the exposure, pose with the true one at its end, an
image with its tick (the marker that moves most). `read with the frame` is a loop that reads the
force once when the frame has come; `by component` interpolates the rotation vector as three
numbers, which fails for a tool that points down.""".replace("\n", " ")


def section(values: dict[str, Any], page: Page) -> str:
    """Return the tables of errors, and draw errors against time."""
    units = {"N": "force [N]", "mm": "position [mm]", "deg": "angle [deg]", "px": "marker [px]"}
    lines = []
    for one in values["methods"]:
        errors = [(one[unit], unit) for unit in units if unit in one]
        text = ", ".join(f"{off['rms']:.3g} / {off['most']:.3g} {unit}" for off, unit in errors)
        lines.append([one["stream"], one["method"], text, f"{one['window_us']:.0f}"])
    late = [
        [f"{1e3 * one['uncorrected']:g} ms", *(f"{one[unit]['rms']:.3g}" for unit in units)]
        for one in values["latencies"]
    ]
    head = ["stream", "method", "rms / largest error", f"us a window of {WINDOW}"]
    return "\n\n".join(
        [
            "## Alignment",
            _ABOUT,
            _draw(values["methods"], page),
            table(head, lines),
            "Errors (rms) of the best methods if the camera's latency is off by some ms:",
            table(["off by", *units.values()], late),
        ]
    )


def _draw(methods: list[dict[str, Any]], page: Page) -> str:
    with chart(page.picture("alignment"), 9, 3) as figure:
        for axes, (stream, (_, unit)) in zip(figure.subplots(1, 2), DEFAULTS.items(), strict=True):
            for mark, one in zip(
                "osD^v", (one for one in methods if one["stream"] == stream), strict=False
            ):
                axes.plot(one["window_us"], one[unit]["rms"], mark, label=one["method"])
            axes.set(title=stream, xscale="log", yscale="log", ylabel=f"error rms [{unit}]")
            axes.set(xlabel=f"time of a window of {WINDOW} [us]")
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return page.link("alignment", "Error of each method against its time")
