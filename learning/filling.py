"""Writes a marker archive from anything whose frames can be read by rows; goes on where it was."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan

CHUNK_ROWS, UNIT_ROWS = 32, 256
"""Frames that are compressed together, and frames that are written at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Rows of one sensor."""

    packed: NDArray[np.uint8]
    """Packed masks (n, 38400)."""
    table: Mapping[str, NDArray[Any]]
    """Columns of `recorder.archive.GIVEN`."""
    source: Sequence[str]
    """A line of provenance for each."""


class SensorFrames(Protocol):
    """A sensor whose frames can be made at any time, the same ones each time."""

    @property
    def plan(self) -> SensorPlan:
        """What the archive will hold of it."""
        ...

    def read(self, rows: slice) -> Frames:
        """Make some of its frames."""
        ...


def fill_archive(
    path: Path,
    sensors: Sequence[SensorFrames],
    indenters: Sequence[str],
    attrs: Mapping[str, Any],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Begin an archive or go on with it; return how many frames were made now.

    Killed at any moment and called again with the same sensors, it ends in the same archive.

    Args:
        path: Where it is, or is to be.
        sensors: Its sensors.
        indenters: Names of the indenters, by code.
        attrs: What else is known of the archive; anything JSON holds.
        progress: Called with the frames that are there and those there will be.

    Raises:
        SessionError: Another archive lies there, or something cannot be stored in one.
        LearningError: A frame cannot be made.
        OSError: The disk is full, or not writable.
    """
    plan = ArchivePlan(tuple(sensor.plan for sensor in sensors), tuple(indenters), attrs)
    writer = ArchiveWriter.begin(path, plan)
    missing = writer.missing()
    total = sum(one.rows for one in plan.sensors)
    todo = sum(
        _rows(writer, name, unit).stop - _rows(writer, name, unit).start
        for name, units in missing.items()
        for unit in units
    )
    made = 0
    progress(total - todo, total)
    for sensor in sensors:
        name = sensor.plan.name
        for unit in missing.get(name, ()):
            rows = _rows(writer, name, unit)
            frames = sensor.read(rows)
            writer.sensors[name].write(
                unit, packed=frames.packed, table=frames.table, source=frames.source
            )
            made += rows.stop - rows.start
            progress(total - todo + made, total)
    writer.finish()
    return made


def _rows(writer: ArchiveWriter, name: str, unit: int) -> slice:
    return writer.sensors[name].rows_of(unit)
