"""Checks before recording: every device answers at its rate, the tip is clear; takes the tare."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from recorder.command_line.options import next_command
from rig.acquire.interlocks import Interlocks
from rig.acquire.streams import Streams
from rig.bench.bench import Bench
from rig.bench.stream_kinds import BenchStream
from rig.core.errors import ConfigError, DeviceLost, SafetyStop, raise_all
from rig.core.geometry import compose, invert
from trajectories import Point

logger = logging.getLogger(__name__)

# Least number of periods of the slowest stream over which rates are measured.
_PERIODS = 4
_AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


def check_devices(
    streams: Streams, interlocks: Interlocks | None = None
) -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """Open every device; return `Driver.describe()` and the measured rate [Hz] of each."""
    bench = streams.bench
    description: dict[str, dict[str, Any]] = {}
    failures: list[Exception] = []
    # All are tried, so that a bench with nothing attached is one message and not one per start.
    for opened in (streams.wait_opened, *(() if interlocks is None else (interlocks.open,))):
        try:
            description |= opened()
        except (ConfigError, DeviceLost) as error:
            failures.append(error)
    raise_all(failures)
    rates: dict[str, float] = {}
    window = rate_window(bench, min(row.rate_hz for row in bench.rows))
    for name, measured in streams.measure(window).items():
        rate, expected = measured["rate_hz"], bench.row(name).rate_hz
        rates[name] = rate
        deviation = rate / expected - 1
        logger.info(
            "preflight  %-7s %7.1f Hz (expected %.0f)  longest gap %.1f ms",
            name,
            rate,
            expected,
            1e3 * measured["longest_gap"],
        )
        if rate < 0.5 * expected:
            raise DeviceLost(
                f"{name}: {rate:.1f} Hz measured; expected {expected:.0f} Hz (bench file)"
            )
        if abs(deviation) > bench.preflight.rate_tolerance:
            logger.warning("preflight  %s is %+.0f %% off its expected rate", name, 100 * deviation)
    return description, rates


def rate_window(bench: Bench, rate_hz: float) -> float:
    """Return the time in which to measure the rate of a stream that states `rate_hz` [s]."""
    return max(bench.preflight.rate_window, _PERIODS / rate_hz)


def notes_on(
    description: Mapping[str, Mapping[str, Any]], signals: Sequence[str], calibrated: Sequence[str]
) -> list[str]:
    """Return what the recording will not tell: latencies not measured, and drops not seen."""
    notes = [
        f"{name} latency not calibrated ({next_command('calibrate-latency')})"
        for name in signals
        if name in description and name not in calibrated
    ]
    for name, device in description.items():
        if device.get("numbering", "device") != "device":
            notes.append(f"{name}: drops are only inferred: the device numbers no samples")
    return notes


def tip_position(streams: Streams) -> Point:
    """Return the position of the tip in the contact frame [m]."""
    latest = streams["pose"].latest()
    if latest is None:
        raise DeviceLost("pose: no sample yet")
    x, y, z = compose(invert(streams.bench.contact_frame), latest["value"])[:3].tolist()
    return (x, y, z)


def check_clear(streams: Streams) -> None:
    """Reject a tip at or below the surface, or outside the box."""
    x, y, z = tip_position(streams)
    limits = streams.bench.limits
    inside = (
        limits.box_x[0] <= x <= limits.box_x[1]
        and limits.box_y[0] <= y <= limits.box_y[1]
        and z <= limits.height_max
    )
    where = f"the tip is at x {1e3 * x:.1f}, y {1e3 * y:.1f}, z {1e3 * z:.1f} mm of the sensor"
    if z <= 0:
        raise SafetyStop(f"{where}: at or below its surface; jog it clear, then start again")
    if not inside:
        raise SafetyStop(f"{where}: outside the bench's box; jog it above the sensor")


def take_tares(streams: Streams) -> dict[str, dict[str, Any]]:
    """Return `mean` and `std` (6,) [N, N m] of every F/T sensor, none of which may be touched."""
    bench = streams.bench
    gauges = bench.of_kind("force")
    names = [gauge.name for gauge in gauges]
    window = max([bench.preflight.tare_window, *(settling(gauge) for gauge in gauges)])
    tares = streams.measure(window, *names) if names else {}
    for gauge in gauges:
        _check_tare(bench, gauge, tares[gauge.name])
    return tares


def settling(row: BenchStream) -> float:
    """Return the time in which a stream's readings settle [s]; 0 for one without this."""
    return float(getattr(row.config, "hold", 0.0))


def no_mean(gauge: BenchStream) -> str:
    """Return why a gauge has no mean, for an error."""
    if settling(gauge):
        return f"no settled reading ({gauge.key}.settle_ms, settle_within_n)"
    return "no sample"


def _check_tare(bench: Bench, gauge: BenchStream, tare: dict[str, Any]) -> None:
    if "mean" not in tare:
        raise DeviceLost(f"{gauge.name}: {no_mean(gauge)} during the tare")
    measured = _measured_axes(gauge)
    _require_numbers(gauge, tare["mean"], "during the tare")
    axis, spread = max(
        ((axis, float(tare["std"][axis])) for axis in measured if axis < 3),
        key=lambda each: each[1],
        default=(0, 0.0),
    )
    if spread > bench.preflight.tare_spread:
        raise DeviceLost(
            f"{gauge.name}: {_AXES[axis]} spreads by {spread:.3f} N during the tare; allowed: "
            f"{bench.preflight.tare_spread:.3f} N; is something moving or touching the sensor?"
        )
    logger.info(
        "preflight  tare  %s%s N, spread %.4f N",
        "" if gauge.name == "force" else f"{gauge.name}  ",
        " ".join(f"{value:+.3f}" for value in tare["mean"][:3]),
        spread,
    )


def check_no_contact(bench: Bench, gauge: BenchStream, force: np.ndarray, point: int) -> None:
    """Reject contact above a point: `force` is a gauge's mean tared wrench (6,) there [N, N m]."""
    _require_numbers(gauge, force, f"above point {point}")
    forces = [axis for axis in _measured_axes(gauge) if axis < 3]
    worst = max(forces, key=lambda axis: abs(force[axis]), default=0)
    if forces and abs(force[worst]) > bench.preflight.contact_free:
        which = f"{gauge.name}: " if len(bench.gauges) > 1 else ""
        raise SafetyStop(
            f"point {point}: {which}{_AXES[worst]} is {force[worst]:+.2f} N before the press; "
            f"allowed: {bench.preflight.contact_free:.2f} N; is the surface where the bench file "
            "says?"
        )


def _measured_axes(gauge: BenchStream) -> list[int]:
    """Return the places, among `_AXES`, of the axes that an F/T sensor measures."""
    return [place for place, axis in enumerate(_AXES) if axis in gauge.config.axes_measured]


def _require_numbers(gauge: BenchStream, wrench: np.ndarray, when: str) -> None:
    """Reject a mean wrench (6,) that is NaN or infinite on an axis that the gauge measures."""
    if bad := [_AXES[axis] for axis in _measured_axes(gauge) if not np.isfinite(wrench[axis])]:
        raise DeviceLost(
            f"{gauge.name}: {', '.join(bad)} not a number {when}; is a cable loose? An axis that "
            f"the F/T sensor lacks is left out of the bench file's {gauge.key}.axes_measured"
        )
