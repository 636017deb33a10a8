"""Writes a marker archive from anything whose frames can be read by rows; goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder import MarkerArchive
from recorder.archive import COLUMNS, ArchivePlan, ArchiveWriter, MarkerCount, SensorPlan
from recorder.markers import MarkerCheck, find_blobs, unpack

# Frames that are compressed together, and frames that are written at once.
CHUNK_ROWS, UNIT_ROWS = 32, 256


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


# Frames whose markers are not those of their reference, told of where the frame comes from.

# Keys of a line of provenance: what the marker count said, and why there is no frame.
FLAG, INVALID = "marker_flag", "invalid"


class Flagger:
    """Counts the markers of one sensor's frames."""

    def __init__(self, name: str, references: NDArray[np.uint8], count: MarkerCount | None) -> None:
        """Prepare to compare with references.

        Args:
            name: Of the sensor.
            references: Packed masks of the untouched sensor (K, 38400).
            count: How markers are counted; None: they are not.

        Raises:
            LearningError: A reference without markers.
        """
        self._checks: list[MarkerCheck] = []
        if count is None:
            return
        for number, mask in enumerate(unpack(references)):
            if not len(find_blobs(mask[None], count.smallest_px)):
                raise LearningError(
                    f"{name}: reference {number} has no marker of {count.smallest_px} px or more"
                )
            self._checks.append(
                MarkerCheck(mask, smallest_px=count.smallest_px, tolerance=count.tolerance)
            )

    def flags(
        self,
        masks: NDArray[np.bool_],
        reference: NDArray[np.integer],
        there: NDArray[np.bool_],
    ) -> dict[int, str]:
        """Return what is wrong with the markers of frames, by row; nothing of sound ones.

        Args:
            masks: Frames (n, 480, 640).
            reference: Number of the reference of each (n,).
            there: Which of them there are (n,).
        """
        flags: dict[int, str] = {}
        if not self._checks:
            return flags
        for number in np.unique(reference[there]).tolist():
            rows = np.flatnonzero(there & (reference == number))
            for flag in self._checks[number].flags(masks[rows]):
                text = f"{flag.found} markers, reference {flag.expected}: {flag.reason}"
                flags[int(rows[flag.row])] = text
        return flags


# One number for what an archive says of itself and of its frames, without reading them all.


def archive_fingerprint(archive: MarkerArchive) -> str:
    """Return the SHA-256 of attributes, tables, provenance and references, 64 hexadecimal digits.

    Masks and fields are left out: there are gigabytes of them, and whoever makes others says so in
    the attributes or in the lines of provenance.

    Raises:
        SessionError: The archive is still being written, or a table is damaged.
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
        digest.update(sensor.references.tobytes())
    return digest.hexdigest()
