"""Streams of a bench: their drivers, columns on disk, and records of the newest sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recorder import (
    Column,
    StreamSpec,
    Traits,
    arm_wrench_spec,
    camera_spec,
    force_spec,
    pose_spec,
    taxels_spec,
)
from recorder.command_line.extras import extra_of
from rig.core.clock import Clock
from rig.core.driver import Driver
from rig.core.errors import ConfigError
from rig.core.samples import latest_dtype
from rig.devices import registry


@dataclass(frozen=True, slots=True)
class StreamKind:
    """One row of the table below."""

    spec: Callable[..., StreamSpec]
    """Returns its storage, given its rate [Hz]."""
    record: Callable[[dict[str, Any], int], tuple[Any, ...]]
    """Builds that record from a sample's columns and row (-1 while nothing is recorded)."""
    averaged: bool
    """True if a mean of its values is meaningful (a tare, a reference)."""


# By the names of `recorder.spec.KINDS`. A driver may return more columns than are stored, for the
# guard.
KINDS = {
    "force": StreamKind(
        force_spec,
        lambda sample, row: (sample["t_ns"], sample["status"], sample["value"]),
        True,
    ),
    "pose": StreamKind(
        pose_spec,
        lambda sample, row: (
            sample["t_ns"],
            sample["device_t"],
            sample["safety_status"],
            sample["runtime_state"],
            sample["speed_scaling"],
            sample["value"],
        ),
        False,
    ),
    "arm_wrench": StreamKind(
        arm_wrench_spec,
        lambda sample, row: (sample["t_ns"], 0, sample["value"]),
        True,
    ),
    "camera": StreamKind(camera_spec, lambda sample, row: (sample["t_ns"], row), False),
    "taxels": StreamKind(
        taxels_spec,
        lambda sample, row: (sample["t_ns"], sample["value"]),
        True,
    ),
}

_READING = Column(
    "reading", "float64", units="N", description="Fz as read, also while it has not settled"
)


@dataclass(frozen=True, slots=True)
class BenchStream:
    """One stream of a bench."""

    name: str
    """Name of the stream, on disk and on screen."""
    config: Any
    """Settings of its device."""
    listed: bool = False
    """True if the bench file has it under `streams`."""

    @property
    def key(self) -> str:
        """Key of the device in the bench file, for errors."""
        return f"streams.{self.name}" if self.listed else self.name

    @property
    def kind(self) -> str:
        """Kind of the stream: camera, force, pose, taxels or arm_wrench."""
        return str(self.config.STREAM)

    @property
    def rate_hz(self) -> float:
        """Rate that the bench file states [Hz]."""
        return float(self.config.rate_hz)

    @property
    def shape(self) -> dict[str, int]:
        """Number of taxels and of their axes of a stream of taxels, for its storage."""
        if self.kind != "taxels":
            return {}
        rows, columns, axes = self.config.shape
        return {"taxels": rows * columns, "axes": axes}

    @property
    def uses(self) -> dict[str, Any]:
        """Alignment and roles where the bench file states them, as attributes of the stream."""
        stated = {key: getattr(self.config, key, None) for key in ("align", "roles")}
        return {key: value for key, value in stated.items() if value is not None}

    @property
    def traits(self) -> Traits:
        """Kind, alignment and roles, as they are stored."""
        return self.empty_spec().traits

    @property
    def latest(self) -> np.dtype[Any]:
        """Dtype of its newest sample in shared memory."""
        return latest_dtype(self.kind, tuple(self.shape.values()))

    def empty_spec(self) -> StreamSpec:
        """Return its storage as far as it is known before its device is open."""
        return KINDS[self.kind].spec(self.rate_hz, name=self.name, **self.shape, **self.uses)

    def spec(self, description: dict[str, Any], rate_hz: float, **attrs: Any) -> StreamSpec:
        """Return its storage, with `Driver.describe()` of its opened driver and further attrs."""
        attrs = {**self.uses, **attrs}
        if self.kind == "force":
            counted = "none" if description.get("device_clock") == "none" else "counter"
            attrs = {"clock": counted, **attrs}
        elif self.kind == "camera":
            attrs = {
                "height": description["height"],
                "width": description["width"],
                "codec": "jpeg" if description["jpeg_bytes_kept"] else "zstd",
                "numbered": description.get("numbering") == "device",
                "device_clock": description.get("device_clock", "none"),
                **self.config.attrs(description),
                **attrs,
            }
        make = KINDS[self.kind].spec
        spec = make(rate_hz, name=self.name, device=description, **self.shape, **attrs)
        if description.get("settles"):
            # Readings that have not settled are no values of the force, but are kept beside them.
            spec = replace(spec, columns=(*spec.columns[:-1], _READING, spec.columns[-1]))
        return spec

    def driver(self, clock: Clock) -> Driver:
        """Create its driver, whose vendor library is imported only here."""
        device = registry.device(self.config.KIND)
        try:
            return device.make_driver(self.config, clock)
        except ImportError as error:
            extra = extra_of(error.name or "", "rig") or "rig"
            cure = f"install the extra: pip install 'tactile-rig[{extra}]'"
            if device.kind not in registry.DEVICES:
                cure = f"the device {device.kind} of another package needs it"
            raise ConfigError(f"{self.name}: {error.name} is not installed; {cure}") from None
