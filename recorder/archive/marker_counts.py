"""The marker-count check of a sensor: which of its frames lost or gained markers, and why."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from recorder.archive.reader import ArchivedSensor
from recorder.errors import SessionError
from recorder.markers import MarkerCheck, MarkerFlag, unpack

_ROWS = 256  # frames in memory at once


def marker_flags(sensor: ArchivedSensor) -> list[MarkerFlag]:
    """Return the frames whose markers are not those of their reference, in order of rows.

    Rows that are not valid are left out. How markers are counted is attribute `marker_check` of
    the sensor; null asks for no check.

    Raises:
        SessionError: A reference that has no markers or is not there, or a chunk that is missing
            or damaged.
    """
    options = sensor.attrs.get("marker_check")
    if options is None:
        return []
    flags: list[MarkerFlag] = []
    for number in np.unique(sensor.table["reference"]).tolist():
        if not 0 <= number < len(sensor.references):
            raise SessionError(
                f"{sensor.name}: no reference {number}, there are {len(sensor.references)}"
            )
        try:
            check = MarkerCheck(unpack(sensor.references[number]), **options)
        except (ValueError, TypeError) as error:
            raise SessionError(f"{sensor.name}/references row {number}: {error}") from error
        flags += _of_reference(sensor, number, check)
    return sorted(flags, key=lambda flag: flag.row)


def _of_reference(sensor: ArchivedSensor, number: int, check: MarkerCheck) -> Iterator[MarkerFlag]:
    chosen = (sensor.table["reference"] == number) & sensor.table["valid"]
    rows = np.flatnonzero(chosen)
    for first in range(0, len(rows), _ROWS):
        batch = rows[first : first + _ROWS]
        field_of, lattice = None, None
        if sensor.fields is not None:
            field_of, lattice = partial(_field, sensor, batch), sensor.lattice
        flags = check.flags(sensor.masks(batch), field_of=field_of, lattice=lattice)
        for flag in flags:
            yield MarkerFlag(int(batch[flag.row]), flag.found, flag.expected, flag.reason)


def _field(sensor: ArchivedSensor, batch: NDArray[np.int64], frame: int) -> NDArray[np.float16]:
    """Return the displacement of a frame of a batch of rows."""
    return sensor.displacement([int(batch[frame])]).squeeze(axis=0)
