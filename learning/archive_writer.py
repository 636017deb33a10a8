"""Writing of marker archives, resumable, from any source that reads frames by row."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from recorder import MarkerArchive
from recorder.archive import (
    COLUMNS,
    ArchivePlan,
    ArchiveWriter,
    SensorPlan,
    Simulated,
    write_simulated,
)

# Rows per compressed chunk, and rows per write.
CHUNK_ROWS, UNIT_ROWS = 32, 256


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Rows of one sensor."""

    packed: NDArray[np.uint8]
    """Packed masks (n, 38400), or frames of the plan's representation (n, ...)."""
    table: Mapping[str, NDArray[Any]]
    """Columns of `recorder.archive.GIVEN`."""
    source: Sequence[str]
    """Provenance of each row."""
    displacement: NDArray[np.float16] | None = None
    """Displacement fields (n, *lattice.shape) [px], if the sensor's plan has a lattice."""


class SensorFrames(Protocol):
    """A sensor whose frames can be made repeatedly, with the same result each time."""

    @property
    def plan(self) -> SensorPlan:
        """Plan of its part of the archive."""
        ...

    def read(self, rows: slice) -> Frames:
        """Make the given rows."""
        ...


def fill_archive(
    path: Path,
    sensors: Sequence[SensorFrames],
    indenters: Sequence[str],
    attrs: Mapping[str, Any],
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    simulated: Mapping[str, Simulated] | None = None,
) -> int:
    """Begin or resume an archive and return the number of frames made by this call.

    A call that is killed at any moment and repeated with the same sensors yields the same archive.

    Args:
        path: Path of the archive, which may exist in part.
        sensors: Its sensors.
        indenters: Names of the indenters, by code.
        attrs: Further attributes of the archive; JSON values.
        progress: Called with the number of frames that exist and the total.
        simulated: Forces of twins, by sensor; added last.
    """
    plan = ArchivePlan(tuple(sensor.plan for sensor in sensors), tuple(indenters), attrs)
    writer = ArchiveWriter.begin(path, plan)
    missing = writer.missing()
    total = sum(one.rows for one in plan.sensors)
    due = [
        (sensor, one.name, unit, writer.sensors[one.name].rows_of(unit))
        for one, sensor in zip(plan.sensors, sensors, strict=True)
        for unit in missing.get(one.name, ())
    ]
    todo: int = sum(rows.stop - rows.start for *_, rows in due)
    left = todo
    progress(total - left, total)
    for sensor, name, unit, rows in due:
        frames = sensor.read(rows)
        writer.sensors[name].write(
            unit,
            packed=frames.packed,
            table=frames.table,
            source=frames.source,
            displacement=frames.displacement,
        )
        left -= rows.stop - rows.start
        progress(total - left, total)
    writer.finish()
    for name, forces in (simulated or {}).items():
        known = MarkerArchive(path)[name]
        if known.simulated is None or known.simulated.made_from != forces.made_from:
            write_simulated(known, forces.force, forces.spread, forces.made_from)
    return todo


# Fingerprint of an archive that does not need to read its masks.


def archive_fingerprint(archive: MarkerArchive) -> str:
    """Return the SHA-256 of attributes, tables, provenance and references, 64 hexadecimal digits.

    Masks and fields are not hashed: they are gigabytes, and code that makes different ones records
    the difference in the attributes or in the provenance.
    """
    digest = hashlib.sha256()
    digest.update(json.dumps(archive.attrs, sort_keys=True).encode())
    for name, sensor in archive.items():
        digest.update(f"\n{name} {len(sensor)}\n".encode())
        digest.update(json.dumps(sensor.attrs, sort_keys=True).encode())
        for column in COLUMNS:
            values = sensor.table[column]
            digest.update(f"\n{column} {values.dtype.str} {values.shape}\n".encode())
            digest.update(values.tobytes())
        digest.update("\n".join(sensor.sources).encode())
        digest.update(sensor.reference_frames.tobytes())
    return digest.hexdigest()
