"""Guards of a bench: one for each gauge, or what stands in for a gauge with `force: none`.

A force gauge stops the arm before the sensor is damaged. Without one, five things stand in for it:

1. the surface, found by the onset of the sensor's own signal for this indenter and TCP, at most a
   day ago and to 0.05 mm; the arm stops 0.2 mm beyond the planned depth;
2. the signal itself: the largest motion of a marker or deviation of a taxel, and its freshness;
3. the arm's own wrench, where it has one: a crash detector at half the rating of the sensor;
4. the stiffness that is expected of the sensor, with its source: a plan that could exceed half the
   rating is refused before anything moves;
5. low speeds: 2 mm/s in contact, 10 mm/s elsewhere.

`rig.acquire.no_gauge` finds the surface and presses for the first time.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

from rig.bench.bench import NO_GAUGE, Bench, BenchStream
from rig.core.errors import ConfigError
from rig.core.guard import ForceGuard, Guard, GuardLimits
from rig.core.stand_in_guards import CrashGuard, SignalGuard
from trajectories import Plan, dome_height

# Highest speeds in contact and elsewhere [m/s]. All moves of a session lie below 20 mm.
CONTACT_SPEED, TRAVEL_SPEED = 2e-3, 10e-3
# The arm stops this far beyond the planned depth [m].
BEYOND = 0.2e-3
# Fraction of the sensor's rating that a plan may reach, and that a crash is detected at.
FRACTION = 0.5
# Widest accepted interval of the surface [m], and its longest validity [h].
SURFACE_WIDTH, SURFACE_HOURS = 50e-6, 24.0
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
    )
    for row in bench.of_kind("arm_wrench"):
        crash = CrashGuard(FRACTION * rating, bench.limits.stale_pose)
        guards[folder / f"{row.name}.latest"] = crash
    return guards


def planned_depth(bench: Bench, plan: Plan, total: int | None = None) -> float:
    """Return the deepest place below the surface that a plan's first `total` targets reach [m].

    On a dome, a shear towards the apex goes deeper than the press.
    """
    most = len(plan) if total is None else total
    positions = [
        position
        for target in plan.targets()
        if target.index < most
        for move in plan.moves(target)
        for position in (move.start, move.end)
    ]
    return max((dome_height(bench.dome_radius, x, y) - z for x, y, z in positions), default=0.0)


def check_plan(bench: Bench, depth: float) -> None:
    """Reject a plan that could load the sensor beyond half of its rating, pressed `depth` [m]."""
    stand_ins, _, rating = bench.without_gauge
    force = stand_ins.stiffness[1] * depth
    if force > FRACTION * rating:
        raise ConfigError(
            f"{bench.sensor}: the plan presses {1e3 * depth:.3g} mm deep, which could take "
            f"{force:.3g} N at {1e-3 * stand_ins.stiffness[1]:.3g} N/mm "
            f"({stand_ins.stiffness_source}); "
            f"allowed without a gauge: {FRACTION * rating:.3g} N, half of limits.sensor_rating_n, "
            f"so {1e3 * FRACTION * rating / stand_ins.stiffness[1]:.3g} mm"
        )


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
        "stiffness": {"range": list(stand_ins.stiffness), "source": stand_ins.stiffness_source},
        "speed": bench.arm.speed,
        "travel_speed": bench.arm.travel_speed,
    }


def lines(bench: Bench, depth: float) -> list[str]:
    """Return what stands in for the gauge as lines, to print before anything moves."""
    stand_ins, signal, rating = bench.without_gauge
    unit = "px" if signal.kind == "camera" else "counts"
    wrenches = [row.name for row in bench.of_kind("arm_wrench")]
    crash = f"stops at {FRACTION * rating:.3g} N" if wrenches else "none: only the signal guards"
    low, high = (1e-3 * each for each in stand_ins.stiffness)
    return [
        f"no gauge  nothing measures the force on the sensor, rated {rating:.3g} N; forces are "
        "not recorded",
        f"signal    {signal.name} stops the arm at {stand_ins.signal_max:g} {unit}, or after "
        f"{1e3 * stand_ins.stale_signal:.0f} ms without a change",
        f"wrench    of the arm: {crash}",
        f"force     {low * 1e3 * depth:.3g} to {high * 1e3 * depth:.3g} N expected at "
        f"{1e3 * depth:.3g} mm ({low:.3g} to {high:.3g} N/mm, {stand_ins.stiffness_source})",
    ]
