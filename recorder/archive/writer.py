"""Write an archive unit by unit: in any order, in parallel, repeatedly, and safe against crashes.

A unit is a run of rows with its own shard in every large array. Its data is written and made
durable; then a ledger entry marks it as finished and stores its rows of the table. When all units
are finished, the table is assembled from the ledger, the status becomes `complete`, and the ledger
is removed. Each of these steps gives the same bytes when repeated.
"""

import io
import os
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from recorder.archive import format as archive_format
from recorder.archive.reader import ArchivedSensor, Simulated
from recorder.errors import SessionError
from recorder.store.documents import merge_attrs
from recorder.store.files import TEMPORARY, replace_file, sync_directory
from recorder.store.layout import Array

# Record of the finished units of a sensor, with their table rows until all units are finished.
#
# There is one file per unit, `<sensor>/<array>/ledger/<unit>.npz`, written after the unit's data: a
# unit without an entry does not count.

_LINES = "source_lines"
_SUFFIX = ".npz"


class Ledger:
    """Ledger of one sensor."""

    def __init__(self, frames: Path) -> None:
        self.path = frames / archive_format.LEDGER

    def done(self) -> set[int]:
        """Return the numbers of the finished units; none once the archive is complete."""
        if not self.path.is_dir():
            return set()
        stems = {entry.stem for entry in self.path.iterdir() if entry.suffix == _SUFFIX}
        return {int(stem) for stem in stems if stem.isdecimal()}

    def has(self, unit: int) -> bool:
        """Return True if a unit is finished."""
        return self._entry(unit).exists()

    def enter(self, unit: int, columns: Mapping[str, Array], lines: Sequence[str]) -> None:
        """Record a unit as finished, durably: its rows of the table, a source line per row."""
        different = tuple(dict.fromkeys(lines))
        numbers = {line: number for number, line in enumerate(different)}
        source = np.array([numbers[line] for line in lines], "<i4")
        data = io.BytesIO()
        text = np.frombuffer("\n".join(different).encode(), np.uint8)
        arrays: dict[str, Any] = {**columns, archive_format.SOURCE: source, _LINES: text}
        np.savez(data, **arrays)
        replace_file(self._entry(unit), data.getvalue(), several=True)

    def read(self, unit: int) -> tuple[dict[str, Array], list[str]]:
        """Return the rows of a unit by column, and its provenance lines, which `source` indexes."""
        path = self._entry(unit)
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
                columns = {name: stored[name] for name in stored.files}
            return columns, columns.pop(_LINES).tobytes().decode().split("\n")
        except (zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
            raise SessionError(
                f"{path}: damaged ({error}); remove it and write its unit again"
            ) from error

    def remove(self) -> None:
        """Remove all entries, once the table contains them. May be called twice."""
        shutil.rmtree(self.path, ignore_errors=True)

    def _entry(self, unit: int) -> Path:
        return self.path / f"{unit}{_SUFFIX}"


class ArchiveWriter:
    """Writer of an archive. Holds only its path, so that every process can open its own."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open an archive that `begin` created."""
        self.path = Path(path)
        attrs = archive_format.read_archive_attrs(self.path)
        self.sensors: Mapping[str, SensorWriter] = {
            name: SensorWriter(self, name, len(attrs["indenters"])) for name in attrs["sensors"]
        }
        self._indenters: list[str] = attrs["indenters"]

    @classmethod
    def begin(cls, path: str | os.PathLike[str], plan: archive_format.ArchivePlan) -> Self:
        """Create the archive of a plan, or continue the one that the same plan began.

        Raises:
            SessionError: `path` is something else, or the plan has values that JSON cannot hold.
        """
        archive_format.begin(Path(path), plan)
        return cls(path)

    @property
    def complete(self) -> bool:
        """True if nothing remains to be done."""
        return bool(
            archive_format.read_archive_attrs(self.path)["status"] == archive_format.COMPLETE
        )

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
            merge_attrs(self.path, {"status": archive_format.COMPLETE})
        for sensor in self.sensors.values():
            sensor.ledger.remove()
        for left in self.path.rglob(f"*{TEMPORARY}"):
            left.unlink(missing_ok=True)


class SensorWriter:
    """Writer of one sensor of an archive; obtained from `ArchiveWriter.sensors`."""

    def __init__(self, archive: ArchiveWriter, name: str, indenters: int) -> None:
        self.path = archive.path / name
        self._archive = archive
        stored = archive_format.read_sensor(self.path)
        self._frames = stored.frames
        self.ledger = Ledger(self._frames.path)
        self._layouts = {self._frames.path.name: self._frames}
        if stored.displacement is not None:
            self._layouts["displacement"] = stored.displacement
        self._limits = archive_format.Limits(indenters, stored.references.shape[0])

    @property
    def rows(self) -> int:
        """Number of frames."""
        return self._frames.shape[0]

    @property
    def units(self) -> int:
        """Number of units."""
        return self._frames.shards

    def rows_of(self, unit: int) -> slice:
        """Return the rows of a unit."""
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

        Its n frames are packed masks (n, 38400), or as the representation; the table has columns
        `GIVEN`, n values each, and `source` a provenance line per row; rows of one press share
        theirs. If the plan has a lattice, there are fields (n, *lattice.shape) [px].
        """
        rows = self.rows_of(unit)
        count = rows.stop - rows.start
        unit_name = f"{self.path} unit {unit}"
        columns = archive_format.checked_columns(table, count, self._limits, unit_name)
        _check_lines(source, count, unit_name)
        large: dict[str, Array] = {self._frames.path.name: packed}
        if displacement is not None:
            large["displacement"] = displacement
        if large.keys() != self._layouts.keys():
            raise SessionError(
                f"{unit_name}: found {', '.join(large)}, expected {', '.join(self._layouts)}"
            )
        if displacement is not None and np.isinf(displacement).any():
            raise SessionError(f"{unit_name}.displacement: found infinity, expected px or NaN")
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
        """Assemble the table from the ledger, which must contain every unit."""
        entries = [self.ledger.read(unit) for unit in range(self.units)]
        lines: dict[str, int] = {}
        sources = []
        for columns, own in entries:
            rows = [lines.setdefault(line, len(lines)) for line in own]
            sources.append(np.array(rows, "<i4")[columns[archive_format.SOURCE]])
        table = {
            name: np.concatenate([columns[name] for columns, _ in entries])
            for name in archive_format.COLUMNS
            if name != archive_format.SOURCE
        }
        table[archive_format.SOURCE] = np.concatenate(sources)
        archive_format.write_table(self.path, self.rows, table, indenters, list(lines))


def write_simulated(sensor: ArchivedSensor, force: Array, spread: Array, made_from: str) -> None:
    """Add a twin's forces to a sensor of a complete archive, in place of any that it has.

    Fx, Fy, Fz of each frame and their standard deviation are (n, 3) [N]; NaN without a press.
    `made_from` are the twin and settings.

    Raises:
        SessionError: The archive is not complete, or the shapes do not fit its frames.
    """
    rows = len(sensor.table["valid"])
    for name, values in zip(archive_format.SIMULATED, (force, spread), strict=True):
        array = archive_format.column_array(
            sensor.path / "table" / name, rows, attrs={"made_from": made_from}
        )
        array.write_whole(np.asarray(values, "<f8"))
    sync_directory(sensor.path / "table")


def _check_lines(source: Sequence[str], count: int, where: str) -> None:
    if isinstance(source, str) or len(source) != count:
        actual = "one text" if isinstance(source, str) else f"{len(source)} lines"
        raise SessionError(f"{where}.source: found {actual}, expected {count} lines, one a row")
    for line in source:
        if not isinstance(line, str) or not line or "\n" in line or "\0" in line:
            raise SessionError(f"{where}.source: found {line!r}, expected one line of text")


# Writing of a whole archive from sources that make frames by row.

# Frames per compressed chunk of an archive that `fill_archive` writes.
CHUNK_ROWS = 32
# Frames per unit of such an archive.
UNIT_ROWS = 256


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Rows of one sensor."""

    packed: NDArray[np.uint8]
    """Packed masks (n, 38400), or frames of the plan's representation (n, ...)."""
    table: Mapping[str, NDArray[Any]]
    """Columns of `GIVEN`."""
    source: Sequence[str]
    """Provenance of each row."""
    displacement: NDArray[np.float16] | None = None
    """Displacement fields (n, *lattice.shape) [px], if the sensor's plan has a lattice."""


class SensorFrames(Protocol):
    """A sensor whose frames can be made repeatedly, with the same result each time."""

    @property
    def plan(self) -> archive_format.SensorPlan:
        """Plan of its part of the archive."""

    def read(self, rows: slice) -> Frames:
        """Make the given rows."""


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

    Names of indenters are in the order of their codes, attributes are JSON values, and `simulated`
    are forces of twins by sensor, added last. `progress` is called with the number of frames that
    exist and the total.
    """
    plan = archive_format.ArchivePlan(
        tuple(sensor.plan for sensor in sensors), tuple(indenters), attrs
    )
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
        archived = ArchivedSensor(path / name)
        if archived.simulated is None or archived.simulated.made_from != forces.made_from:
            write_simulated(archived, forces.force, forces.spread, forces.made_from)
    return todo
