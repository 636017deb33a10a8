"""Procedure before collecting on a bench without a force gauge.

The surface is first searched at 2 mm/s, up to 8 mm above the place that the bench file states, then
touched at every point of the plan at 0.5 mm/s, in and out. The first press of a sensor with an
indenter goes through the air, touches, and presses 10, 25, 50 and 100 % of the planned depth. Each
stage is a session of its own, and the surface it found moves the contact frame of the next.

`rig.bench.guards` has the rules.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image

from recorder.session import Session
from recorder.spec import OUTCOMES
from rig.acquire.calibration import onset, store
from rig.acquire.calibration.home import home_calibration, truth_lines
from rig.acquire.calibration.onset import TouchedSurface
from rig.acquire.calibration.store import (
    Calibration,
    FirstPressRecord,
    HomeCalibration,
    at_surface,
    tip_heights,
)
from rig.bench.bench import Bench, BenchFile
from rig.bench.guards import SURFACE_HOURS, SURFACE_WIDTH, force_limit, slowed
from rig.core.errors import ConfigError, SafetyStop
from trajectories import FirstPress, Plan, PressShear, Target, Touch

# Speed of the touches [m/s], and heights of the search above and below the stated surface [m].
TOUCH_SPEED = 0.5e-3
SEARCH_ABOVE, SEARCH_BELOW = 8e-3, 2.5e-3
# Change of the signal that ends an approach, in standard deviations of its noise.
CONTACT = 40.0
# A touch begins this far above the lowest place of the search, which was below the surface because
# the signal is late, and ends this far below it [m].
TOUCH_ABOVE, TOUCH_BELOW = 0.7e-3, 0.1e-3
# Largest distance of the surface from the place that the bench file states [m].
SHIFT_MAX = 3e-3
# Largest deviation of a point from the height that the plan expects, relative to the first [m].
UNEVEN_MAX = 0.15e-3


def search_depth(bench: Bench) -> float:
    """Return how far below the stated surface to search [m]: within depth limit and half rating."""
    deepest = bench.expected.depth_of(force_limit(bench))[1]
    return min(SEARCH_BELOW, bench.limits.depth_max, deepest)


def touch_plan(bench: Bench) -> Touch:
    """Return the touches around the surface that the search found, at all points of the plan."""
    plan = bench.trajectory
    if not isinstance(plan, PressShear) or plan.points == (1,):
        return Touch(TOUCH_BELOW, TOUCH_ABOVE, repeats=4, dome_radius=bench.dome_radius)
    # Corners of a cross lie beyond its points; those of half its width lie within.
    scale = 1.0 if plan.layout == "corners" else 0.5
    return Touch(
        TOUCH_BELOW,
        TOUCH_ABOVE,
        repeats=2,
        points=(1, 2, 3, 4, 5),
        step_x=scale * plan.step_x,
        step_y=scale * plan.step_y,
        dome_radius=bench.dome_radius,
    )


def rough_height(session: Session) -> float:
    """Return the height of the tip at the first contact of a recorded search [m]."""
    lowest = float(tip_heights(session)[1].min())
    outcomes = list(session.segments["outcome"])
    if not outcomes or outcomes[0] != OUTCOMES.index("force_limited"):
        raise SafetyStop(
            f"home: no contact in the signal down to {1e3 * lowest:+.2f} mm of the "
            "stated surface; is the contact frame of the bench file right, the right indenter on "
            "the arm, and the sensor alive?"
        )
    return lowest


def shifted(shift: float) -> SafetyStop:
    """Return the error of a surface that is too far from the stated one, `shift` [m] above it."""
    return SafetyStop(
        f"home: the surface is {1e3 * shift:+.2f} mm from where the bench file states it; "
        f"allowed: {1e3 * SHIFT_MAX:g} mm; is another indenter on the arm, or arm.tcp wrong?"
    )


def check_surface(found: TouchedSurface, shift: float) -> None:
    """Reject a surface that is not known well enough, is not where it was stated, or is uneven.

    It was touched in a frame that the search moved; `shift` is its height above the place that the
    bench file states [m].
    """
    if found.surface.width > SURFACE_WIDTH:
        raise SafetyStop(
            f"home: the interval of the surface is {1e3 * found.surface.width:.3f} mm wide; "
            f"allowed: {1e3 * SURFACE_WIDTH:.3f} mm; is the light of the sensor steady?"
        )
    if abs(shift) > SHIFT_MAX:
        raise shifted(shift)
    first = next(iter(found.heights))
    uneven = {point: z - found.heights[first] for point, z in found.heights.items()}
    point, worst = max(uneven.items(), key=lambda each: abs(each[1]))
    if abs(worst) > UNEVEN_MAX:
        tilt = ""
        if found.slopes is not None:
            across, along = np.degrees(found.slopes)
            tilt = f"; it tilts by {across:+.2f} deg along x and {along:+.2f} deg along y"
        raise SafetyStop(
            f"home: the surface at point {point} is {1e3 * worst:+.2f} mm from that at point "
            f"{first}; allowed: {1e3 * UNEVEN_MAX:g} mm{tilt}: correct the rotation of "
            "contact_frame, or dome_radius_mm"
        )


def check_home(bench: Bench, calibration: Calibration, hint: str) -> None:
    """Reject a surface that is missing, old or not known well enough; `hint` measures it."""
    home = calibration.home
    if home is None:
        raise ConfigError(
            f"{bench.sensor}: without a gauge, the surface must be known for the indenter "
            f"{bench.indenter}; measure it: {hint}"
        )
    width = home.interval[1] - home.interval[0]
    if width > SURFACE_WIDTH:
        raise ConfigError(
            f"{calibration.file}: the surface is known to {1e3 * width:.3f} mm; allowed without a "
            f"gauge: {1e3 * SURFACE_WIDTH:.3f} mm; measure again: {hint}"
        )
    hours = store.age_hours(home.date_utc)
    if not 0 <= hours <= SURFACE_HOURS:
        raise ConfigError(
            f"{calibration.file}: the surface was found {hours:.1f} h ago; allowed without a "
            f"gauge: {SURFACE_HOURS:g} h; measure again: {hint}"
        )


def lines_of(found: TouchedSurface, home: HomeCalibration, bench: Bench) -> list[str]:
    """Return the result as lines; on a mock bench with the World's truth."""
    low, high = (1e3 * value for value in home.interval)
    lines = [
        f"home: surface {1e3 * home.shift:+.3f} mm along z of the bench file's contact frame "
        f"(95 % {low:+.3f} to {high:+.3f} mm); the signal is {1e3 * found.delay:.3f} mm late at "
        f"{1e3 * TOUCH_SPEED:g} mm/s"
    ]
    if found.slopes is not None:
        across, along = np.degrees(found.slopes)
        lines.append(
            f"home: it tilts by {across:+.2f} deg along x, {along:+.2f} deg along y; heights "
            + ", ".join(f"{point}: {1e3 * z:+.3f}" for point, z in found.heights.items())
            + " mm"
        )
    return [*lines, *truth_lines(bench, home.shift)]


class Record(Protocol):
    """Records one stage as a session of its own."""

    def __call__(
        self,
        what: str,
        plan: Plan,
        prepared: Callable[[Bench], Bench],
        *,
        contact_change: float = math.inf,
        after_target: Callable[[Target, Session], None] | None = None,
    ) -> Session:
        """Press `plan` on the bench that `prepared` returns, and return the session.

        `what` is part of its name: search, home, first-press. A press ends at this change of the
        signal, in standard deviations. `after_target` is called with each target and the session.

        Raises:
            StageStopped: The session was stopped.
        """


def prepare(
    file: BenchFile,
    calibrations: Path,
    calibration: Calibration,
    depth: float,
    record: Record,
    ask: Callable[[list[str]], None],
) -> Calibration:
    """Run the stages that must precede a collection, and return its calibration.

    A lab bench was measured by `tactile home`, and asks at every step of the first press. A mock
    bench asks nothing, and finds its surface now unless `tactile home` or `tactile setup` has found
    that of the same bench file and indenter as lately as a lab's must be.

    The plan's deepest indentation is `depth` [m]. `ask` is called with the lines to show after each
    step of the first press, and raises to stop.
    """
    bench = file.bench
    if bench.mock and not _is_found(file, calibration):
        home = find_surface(file, record)
        calibration = dataclasses.replace(calibration, home=home, file="found in the same run")
        press_in_steps(bench, calibration, depth, record, ask)
    elif not store.pressed_before(calibrations, bench, bench.indenter, depth):
        made = press_in_steps(bench, calibration, depth, record, ask)
        store.store(calibrations, bench.sensor, first_press={bench.indenter: made})
    return calibration


def _is_found(file: BenchFile, calibration: Calibration) -> bool:
    """Return True if the surface of this very mock bench was found lately and well enough."""
    home = calibration.home
    if home is None or home.bench_sha256 != store.bench_hash(file.content):
        return False
    try:
        check_home(file.bench, calibration, "")
    except ConfigError:
        return False
    return True


def find_surface(file: BenchFile, record: Record) -> HomeCalibration:
    """Search and touch the surface of a bench as its file describes it; return the calibration."""
    bench = file.bench
    travel, radius = search_depth(bench), bench.dome_radius
    session = record(
        "search",
        Touch(travel=travel, clearance=SEARCH_ABOVE, repeats=1, dome_radius=radius),
        lambda ready: slowed(ready, search_depth(ready)),
        contact_change=CONTACT,
    )
    rough = rough_height(session)
    if abs(rough) > SHIFT_MAX + TOUCH_ABOVE:
        raise shifted(rough)
    touches = touch_plan(bench)
    session = record(
        "home",
        touches,
        lambda ready: slowed(at_surface(ready, rough), TOUCH_BELOW, speed=TOUCH_SPEED),
    )
    surface = onset.touched_by_signal(session, touches)
    home = home_calibration(onset.SIGNAL_METHOD, surface, file, raised=rough)
    print("\n".join(lines_of(surface, home, bench)), flush=True)
    check_surface(surface, home.shift)
    return home


def press_in_steps(
    bench: Bench,
    calibration: Calibration,
    depth: float,
    record: Record,
    ask: Callable[[list[str]], None],
) -> FirstPressRecord:
    """Press for the first time, in steps to `depth` [m], and return the record; see `prepare`."""
    plan = FirstPress(depth)
    largest: list[float] = []

    def after(target: Target, session: Session) -> None:
        motion, image = largest_of(session, target.index)
        largest.append(motion)
        lines = [f"first press, {plan.names[target.index]}: the signal reached {motion:.3g}"]
        if image is not None:
            picture = session.path.with_name(f"{session.path.stem}-{target.index + 1}.png")
            Image.fromarray(image).save(picture)
            lines.append(f"picture at its end: {picture}")
        if target.index + 1 < len(plan):
            following = max(plan.depths[target.index + 1], 0.0)
            lines.append(f"next: {plan.names[target.index + 1]}, {1e3 * following:.3g} mm deep")
        ask(lines)

    record(
        "first-press",
        plan,
        lambda ready: slowed(calibration.applied(ready), depth),
        after_target=after,
    )
    return FirstPressRecord(
        date_utc=store.now_utc(),
        mock=bench.mock,
        tcp=tuple(bench.arm.tcp),
        depth=depth,
        signals=tuple(largest),
    )


def largest_of(session: Session, index: int) -> tuple[float, np.ndarray | None]:
    """Return the largest signal while target `index` went down, and the last image of that way."""
    name = session.signal
    if name is None:
        return float("nan"), None
    stream = session.streams[name]
    start, end = onset.span_of(session, index)
    rows = np.flatnonzero((stream.t_ns >= start) & (stream.t_ns < end))
    levels = onset.levels_of(stream, rows)
    motion = max((level.motion for level in levels), default=float("nan"))
    image = None
    if stream.traits.kind == "camera" and rows.size:
        image = np.asarray(stream.images(rows[-1:]))[0]
    return motion, image
