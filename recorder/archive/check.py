"""Check an archive for every known problem: reads all of it and changes nothing."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recorder.archive import format as archive_format
from recorder.archive.reader import ArchivedSensor
from recorder.archive.writer import Ledger
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.markers import MarkerCheck, MarkerFlag, unpack
from recorder.store.files import Files
from recorder.store.reader import ColumnReader

_ROWS = 256  # frames in memory at once


def marker_flags(sensor: ArchivedSensor) -> list[MarkerFlag]:
    """Return the frames whose markers differ from those of their reference, in order of rows.

    Rows that are not valid are ignored. Attribute `marker_check` of the sensor sets how markers are
    counted; null disables the check.

    Raises:
        SessionError: A reference that is missing or has no markers, or a chunk that is missing or
            corrupt.
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
    return sensor.displacement([int(batch[frame])]).squeeze(axis=0)


Kind = tuple[str, tuple[int, ...], str]

_NAMED = 3  # number of rows for which a finding gives the reason
_LISTED = 20  # number of rows that a finding lists


def check_archive(files: Files, path: Path) -> Iterator[Finding]:
    """Yield the problems of an archive, a directory of `files`; none for a valid one.

    Raises:
        SessionError: Not an archive.
    """
    attrs = archive_format.read_archive_attrs(path, files)
    if attrs["status"] != archive_format.COMPLETE:
        yield Finding("unfinished", ".", _progress(files, path, attrs["sensors"]))
        return
    left = [file for file in files.listed(path) if file.suffix in (".tmp", ".npz")]
    if left:
        message = f"{len(left)} files, first {left[0].relative_to(path)}"
        yield Finding("left-behind", ".", message)
    for name in attrs["sensors"]:
        try:
            sensor = ArchivedSensor(path / name, files)
            structure = list(_check_structure(sensor))
        except SessionError as error:
            yield Finding("metadata", name, str(error))
            continue
        yield from structure
        damage = list(_check_chunks(sensor))
        yield from damage
        if not structure and not damage:
            content = list(_check_content(sensor, len(attrs["indenters"])))
            yield from content
            if not any(finding.where.endswith("table/reference") for finding in content):
                yield from _check_counts(sensor)


def _progress(files: Files, path: Path, names: list[str]) -> str:
    if not files.local:
        return "status is not 'complete': it was copied while it was being written"
    frames = [ArchivedSensor(path / name, files).layout for name in names]
    done = sum(len(Ledger(layout.path).done()) for layout in frames)
    units = sum(layout.shards for layout in frames)
    return f"{done} of {units} units are written; run the command that made it again to continue"


def _check_structure(sensor: ArchivedSensor) -> Iterator[Finding]:
    for name, layout in _layouts(sensor).items():
        array_path = f"{sensor.name}/{name}"
        stored = (layout.data_type, layout.shape[1:], layout.units)
        expected = _prescribed(sensor, name, stored)
        if stored != expected:
            yield Finding("wrong-dtype", array_path, f"found {stored}, expected {expected}")
        if name not in ("references", "sources") and layout.rows() != len(sensor):
            message = f"found {layout.rows()} rows, the sensor has {len(sensor)} frames"
            yield Finding("unequal-lengths", array_path, message)
    fields = None if sensor.keeps_displacement else sensor.fields
    if fields is not None and len(fields) != len(sensor):
        owner = sensor.attrs.get("displacement_of")
        message = f"displacement_of {owner} has {len(fields)} rows, the sensor has {len(sensor)} "
        yield Finding("unequal-lengths", sensor.name, f"{message}frames")


def _prescribed(sensor: ArchivedSensor, name: str, stored: Kind) -> Kind:
    """Return the type, row shape and units that an array must have."""
    if name in (sensor.representation.array, "references"):
        return ("uint8", sensor.representation.shape, "1")
    if name == "displacement":
        return ("float16", sensor.lattice.shape, "px")
    if name == "sources":
        return ("uint8", stored[1], "1")
    column = {**archive_format.COLUMNS, **archive_format.SIMULATED}[name.removeprefix("table/")]
    return (column.dtype, column.shape, column.units)


def _layouts(sensor: ArchivedSensor) -> dict[str, archive_format.ArchiveArray]:
    names = [sensor.representation.array, "references", "sources"]
    columns = {group.name for group in sensor.files.groups(sensor.path / "table")}
    simulated = [name for name in archive_format.SIMULATED if name in columns]
    names += [f"table/{name}" for name in (*archive_format.COLUMNS, *simulated)]
    if sensor.keeps_displacement:
        names.insert(1, "displacement")
    return {
        name: archive_format.ArchiveArray.load(sensor.path / name, sensor.files) for name in names
    }


def _check_chunks(sensor: ArchivedSensor) -> Iterator[Finding]:
    """Decode every chunk, which verifies its checksum."""
    for name, layout in _layouts(sensor).items():
        reader = ColumnReader(layout)
        faults: dict[str, list[str]] = {"missing-chunk": [], "bad-crc": []}
        for number in range(-(-len(reader) // layout.rows_per_chunk)):
            try:
                layout.decoded(reader.chunk(number))
            except SessionError as error:
                code = "missing-chunk" if str(error).endswith("missing") else "bad-crc"
                faults[code].append(str(error))
        for code, messages in faults.items():
            if messages:
                message = f"{len(messages)} found, first: {messages[0]}"
                yield Finding(code, f"{sensor.name}/{name}", message)


def _check_content(sensor: ArchivedSensor, indenters: int) -> Iterator[Finding]:
    limits = archive_format.Limits(indenters, len(sensor.reference_frames), len(sensor.sources))
    for name in archive_format.COLUMNS:
        values = sensor.table[name]
        rows = np.flatnonzero(archive_format.misplaced(name, values, limits))
        if rows.size:
            code = "nan" if values.dtype.kind == "f" else "bad-code"
            allowed = archive_format.allowed(name, limits)
            message = f"{_some(rows)}: found {values[rows[0]]}; allowed: {allowed}"
            yield Finding(code, f"{sensor.name}/table/{name}", message)
    fields = sensor.fields
    if fields is None or not sensor.keeps_displacement:
        return
    step = fields.layout.rows_per_shard
    for first in range(0, len(fields), step):
        infinite = np.isinf(fields.rows_between(first, first + step))
        wrong = np.asarray(infinite.any(axis=(1, 2, 3)))
        if wrong.any():
            message = f"{_some(np.flatnonzero(wrong) + first)}: found infinity, allowed: px or NaN"
            yield Finding("nan", f"{sensor.name}/displacement", message)


def _check_counts(sensor: ArchivedSensor) -> Iterator[Finding]:
    try:
        flags = marker_flags(sensor)
    except SessionError as error:
        yield Finding("marker-count", sensor.name, str(error))
        return
    if flags:
        fraction = len(flags) / len(sensor)
        reasons = "; ".join(map(str, flags[:_NAMED]))
        rows = _some(np.array([flag.row for flag in flags]))
        message = f"{fraction:.3%} of the frames, {rows}. {reasons}"
        yield Finding("marker-count", f"{sensor.name}/markers", message)


def _some(rows: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> str:
    listed = ", ".join(map(str, rows[:_LISTED].tolist()))
    more = len(rows) - _LISTED
    return f"row{'s' * (len(rows) > 1)} {listed}" + (f" and {more} more" if more > 0 else "")
