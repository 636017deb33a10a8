"""Write an archive unit by unit: in any order, in parallel, repeatedly, and safe against crashes.

A unit is a run of rows with its own shard in every large array. Its data is written and made
durable; then a ledger entry marks it as finished and stores its rows of the table. When all units
are finished, the table is assembled from the ledger, the status becomes `complete`, and the ledger
is removed. Each of these steps gives the same bytes when repeated.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recorder.archive.array import Array, ArrayLayout, ArraySpec
from recorder.archive.ledger import Ledger
from recorder.archive.plan import COMPLETE, FORMAT, FORMAT_VERSION, ArchivePlan, begin
from recorder.archive.reader import ArchivedSensor
from recorder.archive.table import (
    COLUMNS,
    SIMULATED,
    SOURCE,
    Limits,
    checked_columns,
    column_spec,
    write_whole,
)
from recorder.errors import SessionError
from recorder.spec import PHASES
from recorder.store.durable import TEMPORARY, sync_directory
from recorder.store.files import LOCAL
from recorder.store.layout import merge_attrs, read_attrs, write_group

_SOURCE_CHUNK = 256


class ArchiveWriter:
    """Writer of an archive. Holds only its path, so that every process can open its own."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open an archive that `begin` created."""
        self.path = Path(path)
        attrs = self._attrs()
        self.sensors: Mapping[str, SensorWriter] = {
            name: SensorWriter(self, name, len(attrs["indenters"])) for name in attrs["sensors"]
        }
        self._indenters: list[str] = attrs["indenters"]

    @classmethod
    def begin(cls, path: str | os.PathLike[str], plan: ArchivePlan) -> Self:
        """Create the archive of a plan, or continue the one that the same plan began.

        Raises:
            SessionError: `path` is something else, or the plan has values that JSON cannot hold.
        """
        begin(Path(path), plan)
        return cls(path)

    @property
    def complete(self) -> bool:
        """True if nothing remains to be done."""
        return bool(self._attrs()["status"] == COMPLETE)

    def missing(self) -> dict[str, list[int]]:
        """Return the units of each sensor that remain to be written; empty if complete."""
        if self.complete:
            return {}
        missing = {name: sensor.missing() for name, sensor in self.sensors.items()}
        return {name: units for name, units in missing.items() if units}

    def finish(self) -> None:
        """Assemble the tables and close the archive. May be repeated, by one process at a time.

        Raises:
            SessionError: Units are missing, or a ledger entry is corrupt.
        """
        missing = self.missing()
        if missing:
            name, units = next(iter(missing.items()))
            count = sum(map(len, missing.values()))
            raise SessionError(
                f"{self.path}: {count} units are missing, first {name} unit {units[0]}"
            )
        if not self.complete:
            for sensor in self.sensors.values():
                sensor.write_table(self._indenters)
            merge_attrs(self.path, {"status": COMPLETE})
        for sensor in self.sensors.values():
            sensor.ledger.remove()
        for left in self.path.rglob(f"*{TEMPORARY}"):
            left.unlink(missing_ok=True)

    def _attrs(self) -> dict[str, Any]:
        return read_attrs(self.path, LOCAL, what="archive", format_=FORMAT, version=FORMAT_VERSION)


class SensorWriter:
    """Writer of one sensor of an archive; obtained from `ArchiveWriter.sensors`."""

    def __init__(self, archive: ArchiveWriter, name: str, indenters: int) -> None:
        """Read the plan of the sensor from its metadata."""
        self.path = archive.path / name
        self._archive = archive
        sensor = ArchivedSensor(self.path)
        self._frames = sensor.stored.layout
        self.ledger = Ledger(self._frames.path)
        self._layouts = {sensor.representation.array: self._frames}
        if sensor.keeps_displacement:
            self._layouts["displacement"] = ArrayLayout.load(self.path / "displacement")
        references = ArrayLayout.load(self.path / "references").rows
        self._limits = Limits(indenters, references)

    @property
    def rows(self) -> int:
        """Number of frames."""
        return self._frames.rows

    @property
    def units(self) -> int:
        """Number of units."""
        return self._frames.shards

    def rows_of(self, unit: int) -> slice:
        """Return the rows of a unit.

        Raises:
            SessionError: No such unit.
        """
        if not 0 <= unit < self.units:
            raise SessionError(f"{self.path}: no unit {unit}, the sensor has {self.units}")
        return self._frames.rows_of_shard(unit)

    def missing(self) -> list[int]:
        """Return the units that remain to be written, ascending."""
        if self._archive.complete:
            return []
        done = self.ledger.done()
        return [unit for unit in range(self.units) if unit not in done]

    def write(
        self,
        unit: int,
        *,
        packed: NDArray[np.uint8],
        table: Mapping[str, Any],
        source: Sequence[str],
        displacement: NDArray[np.float16] | None = None,
    ) -> None:
        """Write one whole unit. A unit that is already finished is not changed.

        Args:
            unit: Number of the unit.
            packed: Frames of its n rows: packed masks (n, 38400), or as the representation.
            table: The columns of `table.GIVEN`, n values each.
            source: One provenance line per row; rows of one press share theirs.
            displacement: Fields (n, *lattice.shape) [px], if the plan has a lattice.

        Raises:
            SessionError: Data that does not match the plan, or a value that is not allowed.
        """
        rows = self.rows_of(unit)
        count = rows.stop - rows.start
        where = f"{self.path} unit {unit}"
        columns = checked_columns(table, count, self._limits, where)
        _check_lines(source, count, where)
        large: dict[str, Array] = {self._frames.path.name: packed}
        if displacement is not None:
            large["displacement"] = displacement
        if large.keys() != self._layouts.keys():
            raise SessionError(
                f"{where}: found {', '.join(large)}, expected {', '.join(self._layouts)}"
            )
        if displacement is not None and np.isinf(displacement).any():
            raise SessionError(f"{where}.displacement: found infinity, expected px or NaN")
        if self._archive.complete or self.ledger.has(unit):
            return
        try:
            for name, values in large.items():
                self._layouts[name].write_shard(unit, values)
            self.ledger.enter(unit, columns, source)
        except FileNotFoundError:
            # Another process wrote this unit and finished the archive in the meantime.
            if not self._archive.complete:
                raise

    def write_table(self, indenters: Sequence[str]) -> None:
        """Assemble the table from the ledger, which must contain every unit.

        Raises:
            SessionError: An entry is corrupt.
            FileNotFoundError: An entry is missing.
        """
        entries = [self.ledger.read(unit) for unit in range(self.units)]
        lines: dict[str, int] = {}
        sources = []
        for entry in entries:
            rows = [lines.setdefault(line, len(lines)) for line in entry.lines]
            sources.append(np.array(rows, "<i4")[entry.columns[SOURCE]])
        path = self.path / "table"
        path.mkdir(exist_ok=True)
        write_group(path, {})
        names = {"indenter": indenters, "phase": PHASES}
        for name in COLUMNS:
            parts = [e.columns[name] for e in entries] if name != SOURCE else sources
            spec = column_spec(name, self.rows, names.get(name, ()))
            write_whole(path / name, spec, np.concatenate(parts))
        _write_sources(self.path / "sources", list(lines))
        for folder in (path, self.path):
            sync_directory(folder)


def write_simulated(sensor: ArchivedSensor, force: Array, spread: Array, made_from: str) -> None:
    """Add a twin's forces to a sensor of a complete archive, in place of any that it has.

    Args:
        sensor: The sensor, of an archive on this machine.
        force: Fx, Fy, Fz of each frame (n, 3) [N]; NaN without a press.
        spread: Their standard deviation (n, 3) [N].
        made_from: The twin and settings that they are from.

    Raises:
        SessionError: The archive is not complete, or the shapes do not fit its frames.
    """
    rows = len(sensor.table["valid"])
    for name, values in zip(SIMULATED, (force, spread), strict=True):
        spec = column_spec(name, rows, attrs={"made_from": made_from})
        write_whole(sensor.path / "table" / name, spec, np.asarray(values, "<f8"))
    sync_directory(sensor.path / "table")


def _check_lines(source: Sequence[str], count: int, where: str) -> None:
    if isinstance(source, str) or len(source) != count:
        found = "one text" if isinstance(source, str) else f"{len(source)} lines"
        raise SessionError(f"{where}.source: found {found}, expected {count} lines, one a row")
    for line in source:
        if not isinstance(line, str) or not line or "\n" in line or "\0" in line:
            raise SessionError(f"{where}.source: found {line!r}, expected one line of text")


def _write_sources(path: Path, lines: Sequence[str]) -> None:
    encoded = [line.encode() for line in lines]
    width = max(map(len, encoded))
    text = np.zeros((len(lines), width), np.uint8)
    for row, data in zip(text, encoded, strict=True):
        row[: len(data)] = np.frombuffer(data, np.uint8)
    spec = ArraySpec(
        "uint8",
        text.shape,
        ("source", "byte"),
        "1",
        "where samples come from: a line of UTF-8 each, padded with zeros",
        _SOURCE_CHUNK,
        -(-len(lines) // _SOURCE_CHUNK) * _SOURCE_CHUNK,
    )
    write_whole(path, spec, text)
