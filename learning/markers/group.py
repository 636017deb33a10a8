"""Sessions that become one archive: they belong together, or are refused by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learning.errors import LearningError
from learning.indenters import coded
from learning.markers.recording import Recording, read_recording


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A recording, and the numbers that its targets have in the archive."""

    recording: Recording
    first_target: int
    """Number of its first target within the indenter."""
    first_location: int | None
    """Location of its first target; None: its targets have none."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorGroup:
    """All recordings of one sensor, indenter by indenter."""

    name: str
    placed: tuple[Placed, ...]

    @property
    def kind(self) -> str:
        """`camera` or `taxels`."""
        return self.placed[0].recording.kind


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """All recordings of an archive."""

    sensors: tuple[SensorGroup, ...]
    indenters: tuple[str, ...]
    """Names, by code."""


def read_group(paths: Sequence[Path], sensor: str | None = None) -> Group:
    """Return sessions as they belong together.

    Targets of two sensors are paired by their numbers, so all sessions with shear must have been
    planned alike: as many targets, with the same points, levels of depth and directions. How deep
    a level is may differ from sensor to sensor, not within one.

    Args:
        paths: The sessions, in any order.
        sensor: What all of them are of, in place of what they say.

    Raises:
        LearningError: Sessions that do not belong together; both are named.
        SessionError: No session, or a damaged one.
    """
    if not paths:
        raise LearningError("sessions: found none; allowed: one or more")
    recordings = [read_recording(path, sensor) for path in paths]
    indenters = coded(one.indenter for one in recordings)
    _require_different(recordings)
    _require_alike(recordings)
    located = [one for one in recordings if one.located]
    targets = located[0].targets if located else 0
    by_sensor: dict[str, list[Recording]] = {}
    for one in recordings:
        by_sensor.setdefault(one.sensor, []).append(one)
    sensors = []
    for name, some in by_sensor.items():
        _require_one_device(some)
        some.sort(key=lambda one: (indenters.index(one.indenter), not one.located))
        placed = [
            Placed(
                one,
                0 if one.located else targets,
                indenters.index(one.indenter) * targets if one.located else None,
            )
            for one in some
        ]
        sensors.append(SensorGroup(name, tuple(placed)))
    return Group(tuple(sensors), indenters)


def _require_different(recordings: Sequence[Recording]) -> None:
    known: dict[tuple[str, str, bool], Recording] = {}
    for one in recordings:
        key = one.sensor, one.indenter, one.located
        other = known.setdefault(key, one)
        if other is not one:
            raise LearningError(
                f"{one.name}: found {one.indenter} on {one.sensor}, as in {other.name}; allowed: "
                "one session for each indenter on a sensor (and one of force and depth)"
            )


def _require_alike(recordings: Sequence[Recording]) -> None:
    """Refuse targets that cannot be paired, and depths that differ within a sensor."""
    located = [one for one in recordings if one.located]
    for one in located[1:]:
        other = located[0]
        if not np.array_equal(one.layout(), other.layout()):
            raise LearningError(
                f"{one.name}: found {one.targets} targets that are not those of {other.name} "
                f"({other.targets}); allowed: sessions of one plan, or an archive for each plan"
            )
    first: dict[str, Recording] = {}
    for one in located:
        other = first.setdefault(one.sensor, one)
        depth, due = one.session.targets["depth"], other.session.targets["depth"]
        if not np.allclose(depth, due, atol=1e-9):
            raise LearningError(
                f"{one.name}: found depths up to {1e3 * depth.max():g} mm, {other.name} of the "
                f"same sensor has {1e3 * due.max():g} mm; allowed: one plan for a sensor"
            )


def _require_one_device(recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    for one in recordings[1:]:
        if one.kind != first.kind:
            raise LearningError(
                f"{one.name}: found {one.kind} of sensor {one.sensor}, {first.name} has "
                f"{first.kind}; allowed: one kind for a sensor"
            )
        if one.kind == "camera" and _size(one) != _size(first):
            raise LearningError(
                f"{one.name}: found pictures of {_size(one)}, {first.name} of the same sensor has "
                f"{_size(first)}; allowed: one size for a sensor"
            )


def _size(recording: Recording) -> tuple[int, ...]:
    camera = recording.session.streams["camera"]
    return camera.layout.columns[0].column.shape
