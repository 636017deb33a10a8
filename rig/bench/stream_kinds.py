"""Kinds of streams: their drivers, columns on disk, and records of the newest sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recorder import (
    Column,
    StreamSpec,
    arm_wrench_spec,
    camera_spec,
    force_spec,
    pose_spec,
    taxels_spec,
)
from rig.bench.bench import Bench
from rig.core.clock import Clock
from rig.core.driver import Driver
from rig.core.errors import ConfigError
from rig.core.samples import CAMERA_LATEST, FORCE_LATEST, POSE_LATEST, latest_dtype
from rig.devices import registry


@dataclass(frozen=True, slots=True)
class StreamKind:
    """One row of the table below."""

    name: str
    """A kind of `recorder.spec.KINDS`."""
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
            "arm_wrench",
            FORCE_LATEST,
            lambda sample, row: (sample["t_ns"], 0, sample["value"]),
            ("value", "device_t", "t_ns"),
            True,
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
            latest_dtype("taxels", (16, 3)),
            lambda sample, row: (sample["t_ns"], sample["value"]),
            ("value", "device_t", "seq", "t_ns"),
            True,
        ),
    )
}


def stream_names(bench: Bench) -> tuple[str, ...]:
    """Return the streams that a bench records, in display order."""
    return tuple(row.name for row in bench.rows)


def kind_of(bench: Bench, name: str) -> StreamKind:
    """Return the kind of a bench's stream."""
    row = bench.row(name)
    kind = KINDS[row.kind]
    if row.shape:
        return replace(kind, latest=latest_dtype(row.kind, tuple(row.shape.values())))
    return kind


def expected_rate(bench: Bench, name: str) -> float:
    """Return the rate that the bench file states for a stream [Hz]."""
    return bench.row(name).rate_hz


def make_driver(bench: Bench, name: str, clock: Clock) -> Driver:
    """Create the driver of one stream; its vendor library is imported only here."""
    device = registry.device(bench.row(name).config.KIND)
    try:
        return device.make_driver(bench.row(name).config, clock)
    except ImportError as error:
        cure = "install the extra: pip install 'tactile-rig[rig]'"
        if device.kind not in registry.DEVICES:
            cure = f"the device {device.kind} of another package needs it"
        raise ConfigError(f"{name}: {error.name} is not installed; {cure}") from None


_READING = Column(
    "reading", "float64", units="N", description="Fz as read, also while it has not settled"
)


def stream_spec(
    bench: Bench, name: str, description: dict[str, Any], rate_hz: float, **attrs: Any
) -> StreamSpec:
    """Return the storage spec of a stream, given the properties of its opened driver.

    Args:
        bench: The bench.
        name: Name of the stream.
        description: `Driver.describe()`.
        rate_hz: Declared rate.
        **attrs: Further attributes.
    """
    row = bench.row(name)
    attrs = {**row.uses, **attrs}
    if row.kind == "force":
        counted = "none" if description.get("device_clock") == "none" else "counter"
        attrs = {"clock": counted, **attrs}
        spec = force_spec(rate_hz, name=name, device=description, **attrs)
        if description.get("settles"):
            # Readings that have not settled are no values of the force, but are kept beside them.
            spec = replace(spec, columns=(*spec.columns[:-1], _READING, spec.columns[-1]))
        return spec
    if row.kind == "pose":
        return pose_spec(rate_hz, name=name, device=description, **attrs)
    if row.kind == "arm_wrench":
        return arm_wrench_spec(rate_hz, name=name, device=description, **attrs)
    if row.kind == "taxels":
        return taxels_spec(rate_hz, name=name, device=description, **row.shape, **attrs)
    attrs = {**row.config.attrs(description), **attrs}
    codec = "jpeg" if description["jpeg_bytes_kept"] else "zstd"
    return camera_spec(
        rate_hz,
        name=name,
        height=description["height"],
        width=description["width"],
        codec=codec,
        numbered=description.get("numbering") == "device",
        device=description,
        device_clock=description.get("device_clock", "none"),
        **attrs,
    )
