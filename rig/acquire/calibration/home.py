"""Finds the surface from slow approaches: fits the onset of force in each and combines them."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from recorder.session import Session, linear
from rig.acquire.calibration.onset import (
    Onset,
    TouchedSurface,
    combine,
    find_onset,
    slopes_of,
    span_of,
)
from rig.acquire.calibration.store import (
    HomeCalibration,
    bench_hash,
    now_utc,
    stream_of,
    tip_heights,
)
from rig.bench.bench import Bench, BenchFile
from rig.core.errors import ConfigError, SafetyStop
from rig.core.geometry import invert, transform
from trajectories import Touch

METHOD = "onset of force, k d^p (1 + c d), profile likelihood"
# Widest accepted interval, unless given [m].
WIDTH_MAX = 50e-6
# Speed of the approach [m/s].
SPEED = 1e-3
# Force that ends the approach, unless given: least and most [N], and its largest part of the force
# that is expected at the end of the travel.
_FORCES, _SHARE = (0.1, 0.3), 0.5
# Noise above this fraction of the contact force would end approaches by itself.
_NOISE_SHARE = 0.2
# Last part of an approach, in which the arm decelerates [m].
_DECELERATING = 10e-6


def force_of(bench: Bench, travel: float | None) -> float:
    """Return the force that ends an approach `travel` deep [m], by default to the limit [N]."""
    depth = bench.limits.depth_max if travel is None else travel
    return float(np.clip(_SHARE * bench.expected.at(depth)[0], *_FORCES))


def touching_bench(bench: Bench, force: float) -> Bench:
    """Return the bench for approaches: 1 mm/s, soft limit `force` [N], same hard limits."""
    limits = bench.limits
    rating = bench.force_rating[2]
    if not 0 < force < 0.5 * limits.soft_fraction * rating:
        raise ConfigError(
            f"--force: found {force} N; allowed: above 0, below half the soft limit "
            f"({0.5 * limits.soft_fraction * rating:.2f} N)"
        )
    return dataclasses.replace(
        bench,
        arm=dataclasses.replace(bench.arm, speed=SPEED),
        limits=dataclasses.replace(limits, soft_fraction=force / rating),
        # A tare spread close to the contact force is rejected before anything moves down.
        preflight=dataclasses.replace(
            bench.preflight,
            tare_spread=min(bench.preflight.tare_spread, _NOISE_SHARE * force),
            contact_free=min(bench.preflight.contact_free, 0.5 * force),
        ),
    )


def evaluate(session: Session, plan: Touch, *, width_max: float = WIDTH_MAX) -> TouchedSurface:
    """Fit every approach of a session along `plan`; accept intervals up to `width_max` wide [m]."""
    approaches: dict[int, list[Onset]] = {}
    for index, target in enumerate(plan.targets()):
        onset = _approach(session, index)
        if onset is None:
            raise SafetyStop(
                f"home: no contact at point {target.point} down to {-1e3 * plan.travel:.2f} mm; "
                "is the contact frame of the bench file right? --travel-mm extends the travel"
            )
        approaches.setdefault(target.point, []).append(onset)
    surfaces = {point: combine(onsets) for point, onsets in approaches.items()}
    first = surfaces[plan.points[0]]
    if first.width > width_max:
        noise = max(onset.noise for onset in approaches[plan.points[0]])
        raise SafetyStop(
            f"home: the interval is {1e3 * first.width:.3f} mm wide; allowed: "
            f"{1e3 * width_max:.3f} mm; force noise {noise:.3f} N, spread between approaches "
            f"{1e3 * first.spread:.3f} mm; more --repeats or more --force-n narrow it"
        )
    heights = {point: surface.z for point, surface in surfaces.items()}
    slopes = slopes_of(heights, {point: plan.position(point) for point in surfaces})
    return TouchedSurface(first, tuple(approaches[plan.points[0]]), heights, slopes)


def _approach(session: Session, index: int) -> Onset | None:
    """Return the onset in target `index`'s downward move, in the session's contact frame."""
    start, end = span_of(session, index)
    force = stream_of(session, "force")
    inside = (force.t_ns >= start) & (force.t_ns < end)
    times = force.t_ns[inside]
    z = linear(*tip_heights(session), times).value
    finite = np.isfinite(z)
    z, pressed = z[finite], -np.asarray(force.array("value"))[inside][finite, 2]
    if not len(z):
        return None
    # The end is cut off: while the arm slows down and stands still, the gel relaxes.
    going = z > z.min() + _DECELERATING
    last = int(np.flatnonzero(going)[-1]) + 1 if going.any() else len(z)
    return find_onset(z[:last], pressed[:last])


def home_calibration(
    method: str, touched: TouchedSurface, file: BenchFile, *, raised: float = 0.0
) -> HomeCalibration:
    """Return the calibration of a surface that was touched `raised` [m] above the bench's frame."""
    bench = file.bench
    low, high = touched.surface.interval
    return HomeCalibration(
        date_utc=now_utc(),
        method=method,
        mock=bench.mock,
        bench_sha256=bench_hash(file.content),
        contact_frame=tuple(bench.contact_frame),
        tcp=tuple(bench.arm.tcp),
        shift=raised + touched.surface.z,
        interval=(raised + low, raised + high),
        contacts=tuple(raised + onset.z for onset in touched.onsets),
    )


def lines_of(found: TouchedSurface, bench: Bench) -> list[str]:
    """Return the result as lines; on a mock bench with the World's truth."""
    surface = found.surface
    low, high = (1e3 * value for value in surface.interval)
    lines = [
        f"approach {number}: contact at {1e3 * onset.z:+.3f} mm (95 % "
        f"{1e3 * onset.interval[0]:+.3f} to {1e3 * onset.interval[1]:+.3f}), power "
        f"{onset.power:.1f}, force noise {onset.noise:.3f} N"
        for number, onset in enumerate(found.onsets, 1)
    ]
    lines.append(
        f"home: surface {1e3 * surface.z:+.3f} mm along z of the bench file's contact frame "
        f"(95 % {low:+.3f} to {high:+.3f} mm)"
    )
    if found.slopes is not None:
        across, along = np.degrees(found.slopes)
        lines.append(
            f"home: the surface tilts by {across:+.2f} deg along x, {along:+.2f} deg along y "
            "(reported; correct contact_frame's rotation_deg if it matters)"
        )
    return [*lines, *truth_lines(bench, surface.z)]


def truth_lines(bench: Bench, height: float) -> list[str]:
    """Return the comparison of a surface's height [m] with the true one; empty on a lab bench."""
    if not bench.mock:
        return []
    origin = np.array((bench.world_frame or bench.contact_frame)[:3])
    truth = float(transform(invert(bench.contact_frame), origin)[2])
    return [
        f"home: the mock bench's true surface is at {1e3 * truth:+.3f} mm: "
        f"difference {1e3 * (height - truth):+.3f} mm"
    ]


def plan_for(
    bench: Bench, *, force: float, travel: float | None, repeats: int, points: Sequence[int]
) -> Touch:
    """Return the touches for a bench: from 1 mm above its surface to `travel` below.

    By default that is 1 mm, or the depth at which the skin takes `force` [N] for certain.
    """
    most = bench.limits.depth_max
    certain = max(1e-3, bench.expected.depth_of(force / _SHARE)[0])
    depth = min(certain, most) if travel is None else travel
    if not 0 < depth <= most:
        raise ConfigError(
            f"--travel-mm: found {1e3 * depth:g}; allowed: above 0, up to {1e3 * most:g} "
            "(limits.depth_max_mm of the bench file)"
        )
    try:
        return Touch(travel=depth, repeats=repeats, points=tuple(points))
    except ValueError as error:
        raise ConfigError(f"home: {error}") from None
