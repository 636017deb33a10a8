"""Guards of a bench: one for each gauge, or what stands in for a gauge with `force: none`.

Before anything moves, the expected force leaves targets out that the bench cannot record, and
bounds the speed of a press.

A force gauge stops the arm before the sensor is damaged. Without one, five things stand in for it:

1. the surface, found by the onset of the sensor's own signal for this indenter and TCP, at most a
   day ago and to 0.05 mm; the arm stops 0.2 mm beyond the planned depth;
2. the signal itself: the largest motion of a marker or deviation of a taxel, and its freshness;
3. the arm's own wrench, where it has one: a crash detector at half the rating of the sensor;
4. the force that is expected of the indenter on the skin: targets that could exceed half the rating
   are left out;
5. low speeds: 2 mm/s in contact, 10 mm/s elsewhere.

`rig.acquire.no_gauge` finds the surface and presses for the first time.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rig.bench.bench import NO_GAUGE, Bench, BenchStream
from rig.core.errors import ConfigError
from rig.core.guard import ForceGuard, Guard, GuardLimits
from rig.core.stand_in_guards import CrashGuard, SignalGuard
from trajectories import Plan, Touch

# Highest speeds in contact and elsewhere [m/s]. All moves of a session lie below 20 mm.
CONTACT_SPEED, TRAVEL_SPEED = 2e-3, 10e-3
# The arm stops this far beyond the planned depth [m].
BEYOND = 0.2e-3
# Fraction of the sensor's rating that a plan may reach, and that a crash is detected at.
FRACTION = 0.5
# Widest accepted interval of the surface [m], and its longest validity [h].
SURFACE_WIDTH, SURFACE_HOURS = 50e-6, 24.0
# Way in contact without a change of the signal that stops the arm [m], and the least number of
# samples on it.
UNSEEN_WAY, UNSEEN_SAMPLES = 0.25e-3, 3
# Slowest press that a stiff contact asks for [m/s].
SLOWEST = 0.2e-3
# Stream of the arm's own wrench on a mock bench that is used without its gauge.
WRENCH_STREAM = "arm_wrench"


def without_gauge(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the content of a mock bench with `force: none` and the wrench of its arm."""
    if not content.get("mock"):
        raise ConfigError(
            f"FORCE, --force: none; {where} is a lab bench; allowed: a mock bench; a lab bench "
            "states `force: none` in its file"
        )
    streams = dict(content.get("streams") or {})
    host = (content.get("arm") or {}).get("host", "loopback")
    streams.setdefault(WRENCH_STREAM, {"kind": "ur_wrench", "host": host, "rate_hz": 125.0})
    return {**content, "force": NO_GAUGE, "streams": streams}


def guard_limits(bench: Bench, gauge: BenchStream | None = None) -> GuardLimits:
    """Return the limits of the guard that watches a gauge; None: only the arm's motion."""
    limits = bench.limits
    motion = GuardLimits(
        force_rating=bench.force_rating,
        soft_fraction=limits.soft_fraction,
        hard_fraction=limits.hard_fraction,
        horizon=limits.horizon,
        stale_force=limits.stale_force,
        stale_pose=limits.stale_pose,
        box=(
            (limits.box_x[0], limits.box_y[0], -limits.depth_max),
            (limits.box_x[1], limits.box_y[1], limits.height_max),
        ),
        dome_radius=bench.dome_radius,
    )
    if gauge is None:
        return motion
    return dataclasses.replace(
        motion,
        force_status_mask=gauge.config.UNTRUSTED_MASK,
        axes_measured=gauge.config.axes_measured,
    )


def gauge_guards(bench: Bench, folder: Path) -> dict[Path, Guard]:
    """Return the guard of each F/T sensor with that role, by its shared record in `folder`."""
    several = len(bench.gauges) > 1
    return {
        folder / f"{row.name}.latest": ForceGuard(
            guard_limits(bench, row), row.name if several else ""
        )
        for row in bench.gauges
    }


def guards_of(bench: Bench, folder: Path, *, contact: float = math.inf) -> dict[Path, Guard]:
    """Return all guards of the arm except that of its own motion, by their shared records.

    Without a gauge, `contact` is the change of the signal that ends a press, in standard deviations
    of its noise.
    """
    guards = gauge_guards(bench, folder)
    if not bench.no_gauge:
        return guards
    stand_ins, signal, rating = bench.without_gauge
    guards[folder / f"{signal.name}.signal"] = SignalGuard(
        stand_ins.signal_max,
        stand_ins.stale_signal,
        "px" if signal.kind == "camera" else "counts",
        contact,
        # An approach has not found the surface yet.
        max(UNSEEN_WAY, UNSEEN_SAMPLES * bench.arm.speed / signal.config.rate_hz)
        if math.isinf(contact)
        else math.inf,
    )
    for row in bench.of_kind("arm_wrench"):
        crash = CrashGuard(FRACTION * rating, bench.limits.stale_pose)
        guards[folder / f"{row.name}.latest"] = crash
    return guards


def force_limit(bench: Bench) -> float:
    """Return the force that ends a press [N], or half of the sensor's rating without a gauge."""
    if bench.no_gauge:
        return FRACTION * bench.without_gauge[2]
    return bench.limits.soft_fraction * bench.force_rating[2]


def left_out(bench: Bench, plan: Plan, depths: Sequence[float]) -> dict[int, float]:
    """Return the targets that the bench cannot record, with the force that they would take [N].

    With a gauge, even the least expected force of these is beyond the soft limit. Without one, the
    largest is beyond half of the sensor's rating. Touches end by their force, whatever their depth.
    The deepest indentations of the targets are `depths` [m].
    """
    if isinstance(plan, Touch):
        return {}
    expected, limit = bench.expected, force_limit(bench)
    forces = (expected.at(depth)[bench.no_gauge] for depth in depths)
    return {index: force for index, force in enumerate(forces) if force > limit}


def left_out_text(bench: Bench, out: Mapping[int, float]) -> str:
    """Return which targets are left out, and why, as text."""
    numbers = np.array(sorted(out)) + 1
    spans = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    which = ", ".join(
        f"{span[0]} to {span[-1]}" if len(span) > 1 else f"{span[0]}" for span in spans
    )
    deepest = bench.expected.depth_of(force_limit(bench))[bench.no_gauge]
    bound = "up to" if bench.no_gauge else "at least"
    return (
        f"not recordable on this bench and left out: target{'s' * (len(out) > 1)} {which}; "
        f"{bench.indenter} takes {bound} {min(out.values()):.3g} N there; allowed: "
        f"{force_limit(bench):.3g} N, so {1e3 * deepest:.3g} mm"
    )


def force_text(bench: Bench, depth: float) -> str:
    """Return the expected force at a depth [m] with its interval, as text."""
    low, high = bench.expected.at(depth)
    limit = "half of the rating" if bench.no_gauge else "soft limit"
    return (
        f"{low:.3g} to {high:.3g} N expected of {bench.indenter} at {1e3 * depth:.3g} mm "
        f"({bench.expected.text}), {limit} {force_limit(bench):.3g} N"
    )


def gentle(bench: Bench, reaction: float) -> Bench:
    """Return the bench with presses that stay below the hard limit while the arm reacts.

    Speed <= (hard limit - soft limit) / (stiffness x reaction [s]), and at least `SLOWEST`.
    """
    if bench.no_gauge:
        return bench
    limits, rating = bench.limits, bench.force_rating[2]
    room = (limits.hard_fraction - limits.soft_fraction) * rating
    most = room / (bench.expected.stiffest(limits.hard_fraction * rating) * reaction)
    arm = dataclasses.replace(bench.arm, speed=min(bench.arm.speed, max(most, SLOWEST)))
    return dataclasses.replace(bench, arm=arm)


def slowed(bench: Bench, depth: float, *, speed: float = CONTACT_SPEED) -> Bench:
    """Return the bench with the speeds and the box that hold without a gauge.

    `depth` is the deepest indentation that is planned [m], `speed` the highest near contact [m/s].
    """
    arm = dataclasses.replace(
        bench.arm,
        speed=min(bench.arm.speed, speed),
        travel_speed=min(bench.arm.travel_speed, TRAVEL_SPEED),
    )
    deepest = min(bench.limits.depth_max, depth) + BEYOND
    limits = dataclasses.replace(bench.limits, depth_max=deepest)
    return dataclasses.replace(bench, arm=arm, limits=limits)


def statement(bench: Bench) -> dict[str, Any]:
    """Return what stood in for a gauge, for the session's attribute `without_gauge` (SI units).

    The bench is that of `slowed`.
    """
    stand_ins, signal, rating = bench.without_gauge
    wrenches = [row.name for row in bench.of_kind("arm_wrench")]
    return {
        "sensor_rating": rating,
        "depth_stop": bench.limits.depth_max,
        "signal": {
            "stream": signal.name,
            "largest": stand_ins.signal_max,
            "unit": "px" if signal.kind == "camera" else "counts",
            "stale": stand_ins.stale_signal,
        },
        "arm_wrench": {"streams": wrenches, "force": FRACTION * rating} if wrenches else None,
        "speed": bench.arm.speed,
        "travel_speed": bench.arm.travel_speed,
    }


def lines(bench: Bench, depth: float, out: Mapping[int, float]) -> list[str]:
    """Return the expected forces of presses to `depth` [m], to print before anything moves.

    `out` are the targets that are left out. Without a gauge, its stand-ins come first.
    """
    text = [f"force     {force_text(bench, depth)}, {1e3 * bench.arm.speed:.3g} mm/s"]
    if out:
        text.append(f"plan      {left_out_text(bench, out)}")
    if not bench.no_gauge:
        return text
    stand_ins, signal, rating = bench.without_gauge
    unit = "px" if signal.kind == "camera" else "counts"
    wrenches = [row.name for row in bench.of_kind("arm_wrench")]
    crash = f"stops at {FRACTION * rating:.3g} N" if wrenches else "none: only the signal guards"
    return [
        f"no gauge  nothing measures the force on the sensor, rated {rating:.3g} N; forces are "
        "not recorded",
        f"signal    {signal.name} stops the arm at {stand_ins.signal_max:g} {unit}, or after "
        f"{1e3 * stand_ins.stale_signal:.0f} ms without a change",
        f"wrench    of the arm: {crash}",
        *text,
    ]
