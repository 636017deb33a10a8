"""Kinds of streams: their drivers, columns on disk, and records of the newest sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from recorder import StreamSpec, camera_spec, force_spec, pose_spec, taxels_spec
from rig.bench.bench import Bench
from rig.core.clock import Clock
from rig.core.driver import Driver
from rig.core.errors import ConfigError
from rig.core.samples import CAMERA_LATEST, FORCE_LATEST, POSE_LATEST, TAXELS_LATEST
from rig.devices.force.settings import AtiSerialConfig, ForceConfig, NidaqConfig


@dataclass(frozen=True, slots=True)
class StreamKind:
    """One row of the table below."""

    name: str
    """Name of the stream, on disk and on screen."""
    latest: np.dtype[Any]
    """Dtype of its newest sample in shared memory."""
    record: Callable[[dict[str, Any], int], tuple[Any, ...]]
    """Builds that record from a sample's columns and row (-1 while nothing is recorded)."""
    columns: tuple[str, ...]
    """Columns to store; a driver may return more, for the guard."""
    averaged: bool
    """True if a mean of its values is meaningful (a tare, a reference)."""


KINDS = {
    kind.name: kind
    for kind in (
        StreamKind(
            "force",
            FORCE_LATEST,
            lambda sample, row: (sample["t_ns"], sample["status"], sample["value"]),
            ("value", "seq", "status", "t_ns"),
            True,
        ),
        StreamKind(
            "pose",
            POSE_LATEST,
            lambda sample, row: (
                sample["t_ns"],
                sample["device_t"],
                sample["safety_status"],
                sample["runtime_state"],
                sample["speed_scaling"],
                sample["value"],
            ),
            ("value", "device_t", "speed_scaling", "t_ns"),
            False,
        ),
        StreamKind(
            "camera",
            CAMERA_LATEST,
            lambda sample, row: (sample["t_ns"], row),
            ("value", "device_t", "t_ns"),
            False,
        ),
        StreamKind(
            "taxels",
            TAXELS_LATEST,
            lambda sample, row: (sample["t_ns"], sample["value"]),
            ("value", "device_t", "seq", "t_ns"),
            True,
        ),
    )
}


def stream_names(bench: Bench) -> tuple[str, ...]:
    """Return the streams that a bench records, in display order."""
    optional = (("camera", bench.camera), ("taxels", bench.taxels))
    return ("force", "pose", *(name for name, config in optional if config is not None))


def expected_rate(bench: Bench, name: str) -> float:
    """Return the rate that the bench file states for a stream [Hz]."""
    configs: dict[str, Any] = {
        "force": bench.force,
        "pose": bench.arm,
        "camera": bench.camera,
        "taxels": bench.taxels,
    }
    return float(configs[name].rate_hz)


def make_driver(bench: Bench, name: str, clock: Clock) -> Driver:
    """Create the driver of one stream; its vendor library is imported only here.

    Raises:
        ConfigError: The library is not installed.
    """
    try:
        if name == "force":
            return _force_driver(bench.force, clock)
        if name == "pose":
            from rig.devices.arm.reader import RtdePoseDriver

            return RtdePoseDriver(bench.arm.host, bench.arm.rate_hz, clock)
        if name == "camera" and bench.camera is not None:
            from rig.devices.camera.opencv import OpenCvDriver

            return OpenCvDriver(bench.camera, clock)
        if name == "taxels" and bench.taxels is not None:
            from rig.devices.taxels.xela import XelaDriver

            return XelaDriver(bench.taxels, clock)
    except ImportError as error:
        raise ConfigError(
            f"{name}: {error.name} is not installed; install the extra: "
            "pip install 'tactile-rig[rig]'"
        ) from None
    raise ConfigError(f"stream: found {name!r}; known: {', '.join(KINDS)}")


def _force_driver(config: ForceConfig, clock: Clock) -> Driver:
    if isinstance(config, NidaqConfig):
        from rig.devices.force.nidaq import NidaqDriver

        return NidaqDriver(config, clock)
    if isinstance(config, AtiSerialConfig):
        from rig.devices.force.ati_serial import AtiSerialDriver

        return AtiSerialDriver(config, clock)
    from rig.devices.force.netft import NetFtDriver

    return NetFtDriver(config, clock)


def stream_spec(
    bench: Bench, name: str, description: dict[str, Any], rate_hz: float, **attrs: Any
) -> StreamSpec:
    """Return the storage spec of a stream, given the facts of its opened driver.

    Args:
        bench: The bench.
        name: Name of the stream.
        description: `Driver.describe()`.
        rate_hz: Measured rate.
        **attrs: Further attributes.
    """
    if name == "force":
        return force_spec(rate_hz, device=description, **attrs)
    if name == "pose":
        return pose_spec(rate_hz, device=description, **attrs)
    if name == "taxels":
        return taxels_spec(rate_hz, device=description, **attrs)
    codec = "jpeg" if description["jpeg_bytes_kept"] else "zstd"
    return camera_spec(
        rate_hz,
        height=description["height"],
        width=description["width"],
        codec=codec,
        device=description,
        device_clock=description.get("device_clock", "none"),
        **attrs,
    )
