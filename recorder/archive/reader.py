"""Read-only access to an archive. Changes nothing and never fills in values."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive.format import (
    COLUMNS,
    COMPLETE,
    MASKS,
    SIMULATED,
    ArchiveArray,
    late_array,
    read_archive_attrs,
    read_sensor,
    require_plain_name,
)
from recorder.command_line.terminal import table
from recorder.errors import SessionError
from recorder.markers import SMALLEST_PX, Lattice, count_markers, unpack
from recorder.store.files import LOCAL, Files, locate
from recorder.store.layout import Array
from recorder.store.reader import ColumnReader, Kept, Table

Rows = Sequence[int] | NDArray[np.integer[Any]] | slice


def _rows_of(reader: ColumnReader, rows: Rows) -> Array:
    """Return some rows (n, ...) in the requested order; each chunk is decoded once."""
    if isinstance(rows, slice):
        start, stop, step = rows.indices(len(reader))
        if step == 1:
            return reader.rows_between(start, stop)
        rows = range(start, stop, step)
    numbers, name = np.asarray(rows), reader.layout.files.name(reader.layout.path)
    if numbers.ndim != 1 or (numbers.size and numbers.dtype.kind not in "iu"):
        raise SessionError(
            f"{name}: found rows {numbers.dtype} {numbers.shape}, expected integers (n,)"
        )
    wrong = numbers[(numbers < 0) | (numbers >= len(reader))]
    if wrong.size:
        raise SessionError(f"{name}: no row {wrong[0]}, the array has {len(reader)}")
    return reader.gathered(numbers.astype(np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """Forces that a twin of a sensor gives for its frames."""

    force: NDArray[np.float64]
    """Fx, Fy, Fz (n, 3) [N]; NaN where there is no press."""
    spread: NDArray[np.float64]
    """Their standard deviation by the twin's uncertainty (n, 3) [N]."""
    made_from: str
    """The twin and settings that they are from."""


class SensorTable(Table):
    """Columns of a sensor's table, read on access; those used last are kept in memory."""

    def __init__(self, sensor: Path, files: Files) -> None:
        self._path, self._files = sensor / "table", files
        self._names = tuple(COLUMNS)
        self._read: Kept[Array] = Kept()

    def _load(self, name: str) -> Array:
        return ColumnReader(late_array(self._path.parent, f"table/{name}", self._files)).read()


class ArchivedSensor:
    """One sensor of an archive: its frames, their references and their table."""

    def __init__(self, path: Path, files: Files = LOCAL) -> None:
        """Open a sensor; use `MarkerArchive` instead."""
        self.name, self.path, self.files = path.name, path, files
        self._stored = read_sensor(path, files)
        self.attrs = self._stored.attrs
        self.representation = self._stored.representation
        """Content of its frames."""
        self.layout = self._stored.frames
        """Array of the frames."""
        self._frames = ColumnReader(self.layout)
        self._references = ColumnReader(self._stored.references)
        self.table: Mapping[str, Array] = SensorTable(path, files)
        """Columns (n, ...) by name, read on first access."""

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def mm_per_px(self) -> float:
        """Size of a pixel on the undeformed surface [mm]."""
        return float(self.attrs["mm_per_px"])

    def packed(self, rows: Rows) -> NDArray[np.uint8]:
        """Return packed masks (n, 38400).

        Raises:
            SessionError: No such row, a chunk that is missing or corrupt, or no masks.
        """
        self._require_masks()
        return self.frames(rows)

    def frames(self, rows: Rows) -> NDArray[np.uint8]:
        """Return frames as stored (n, ...), in the shape of the representation.

        Raises:
            SessionError: No such row, or a chunk that is missing or corrupt.
        """
        return _rows_of(self._frames, rows)

    def _require_masks(self) -> None:
        if self.representation != MASKS:
            raise SessionError(
                f"{self.name}: holds {self.representation.name}, not masks of markers: it can be "
                "split, and trained, scored and seen live by models of its own; what follows "
                "markers cannot be done with it"
            )

    def masks(self, rows: Rows) -> NDArray[np.bool_]:
        """Return masks (n, 480, 640), True on a marker.

        Raises:
            SessionError: No such row, or a chunk that is missing or corrupt.
        """
        return unpack(self.packed(rows))

    @property
    def references(self) -> NDArray[np.uint8]:
        """Packed contact-free masks (K, 38400); `table["reference"]` holds their indices.

        Raises:
            SessionError: The sensor holds no masks.
        """
        self._require_masks()
        return self.reference_frames

    @cached_property
    def reference_frames(self) -> NDArray[np.uint8]:
        """Contact-free frames as stored (K, ...); `table["reference"]` holds their indices."""
        return self._references.read()

    def reference(self, row: int) -> NDArray[np.bool_]:
        """Return the mask (480, 640) of the sensor without contact that a frame is compared with.

        Raises:
            SessionError: No such row, or a chunk that is missing or corrupt.
        """
        if not 0 <= row < len(self):
            raise SessionError(f"{self.name}: no row {row}, the sensor has {len(self)}")
        return unpack(self.references[int(self.table["reference"][row])])

    @property
    def keeps_displacement(self) -> bool:
        """True if displacement fields are stored in this sensor's own group."""
        return self._stored.displacement is not None

    @cached_property
    def fields(self) -> ColumnReader | None:
        """Displacement fields, its own or shared ones; None if there are none.

        Raises:
            SessionError: The shared fields are missing.
        """
        owner = self.attrs.get("displacement_of")
        if owner is None:
            layout = self._stored.displacement
        else:
            owner_path = self.path.parent / require_plain_name(owner)
            layout = ArchiveArray.load(owner_path / "displacement", self.files)
        return None if layout is None else ColumnReader(layout)

    @property
    def lattice(self) -> Lattice:
        """Lattice of the displacement fields.

        Raises:
            SessionError: There are no fields, or their lattice is not stored.
        """
        layout = self._required_fields().layout
        try:
            return Lattice(int(layout.attrs["step_px"]), int(layout.attrs["margin_px"]))
        except (KeyError, TypeError, ValueError) as error:
            array_name = self.files.name(layout.path)
            raise SessionError(f"{array_name}: found no lattice in its attrs: {error!r}") from error

    def displacement(self, rows: Rows) -> NDArray[np.float16]:
        """Return displacement fields (n, *lattice.shape) [px], NaN where there is no material.

        Raises:
            SessionError: No fields stored, no such row, or a chunk that is missing or corrupt.
        """
        return _rows_of(self._required_fields(), rows)

    @cached_property
    def sources(self) -> list[str]:
        """Provenance lines, indexed by `table["source"]`.

        Raises:
            SessionError: A chunk is missing or corrupt, or the archive is still being written.
        """
        text = ColumnReader(late_array(self.path, "sources", self.files)).read()
        return [line.tobytes().rstrip(b"\0").decode() for line in text]

    def provenance(self, rows: Rows) -> list[str]:
        """Return the provenance line of each of some rows.

        Raises:
            SessionError: As for `sources`.
        """
        return [self.sources[source] for source in self.table["source"][rows].tolist()]

    @cached_property
    def simulated(self) -> Simulated | None:
        """Forces of a twin of the sensor; None if `tactile sim labels` has not written any.

        Raises:
            SessionError: A chunk is missing or corrupt, or the archive is still being written.
        """
        columns = {group.name for group in self.files.groups(self.path / "table")}
        if not columns.issuperset(SIMULATED):
            return None
        arrays = [late_array(self.path, f"table/{name}", self.files) for name in SIMULATED]
        force, spread = (ColumnReader(array).read() for array in arrays)
        return Simulated(force, spread, str(arrays[0].attrs.get("made_from", "")))

    def _required_fields(self) -> ColumnReader:
        if self.fields is None:
            raise SessionError(f"{self.name}: keeps no displacement")
        return self.fields


class MarkerArchive(Mapping[str, ArchivedSensor]):
    """One archive, read-only: its sensors by name.

    An archive that is still being written shows the units written so far, and has a `warning`.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, storage_options: Mapping[str, Any] | None = None
    ) -> None:
        """Open an archive.

        Args:
            path: A directory, or a URL that fsspec knows, such as `s3://bucket/x.markers.zarr`.
            storage_options: Options that fsspec needs to open the URL, e.g. `{"anon": True}`.
        """
        self.files, self.path = locate(path, storage_options)
        self.attrs = read_archive_attrs(self.path, self.files)
        self._sensors = {
            name: ArchivedSensor(self.path / name, self.files) for name in self.attrs["sensors"]
        }

    @property
    def name(self) -> str:
        """Location of the archive as a path or URL."""
        return self.files.name(self.path)

    @property
    def status(self) -> str:
        """`writing` or `complete`."""
        return str(self.attrs["status"])

    @property
    def indenters(self) -> tuple[str, ...]:
        """Names of the indenters, by code."""
        return tuple(self.attrs["indenters"])

    @property
    def warning(self) -> str | None:
        """Warning to show before the archive is used, or None."""
        if self.status != COMPLETE:
            return (
                f"{self.name}: still being written, or killed while it was; frames may be missing "
                "and there are no tables (run the command that made it again to continue)"
            )
        return None

    def __getitem__(self, name: str) -> ArchivedSensor:
        if name not in self._sensors:
            raise KeyError(f"{self.name}: no sensor {name!r}; known: {', '.join(self._sensors)}")
        return self._sensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._sensors)

    def __len__(self) -> int:
        return len(self._sensors)


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


def describe_archive(path: str | os.PathLike[str]) -> str:
    """Return a summary of an archive, with one line per sensor."""
    archive = MarkerArchive(path)
    lines = [f"{archive.name}  status {archive.status}, {len(archive)} sensor(s)"]
    if archive.warning:
        lines.append(f"warning: {archive.warning}")
    lines.append(f"  indenters    {', '.join(archive.indenters)}")
    attrs = {key: value for key, value in archive.attrs.items() if isinstance(value, str | int)}
    for key in ("format", "format_version", "status"):
        attrs.pop(key)
    lines += [f"  {key:12s} {value}" for key, value in attrs.items()]
    lines.append("")
    rows = [_row(sensor, tables=not archive.warning) for sensor in archive.values()]
    lines += table({name: [row[name] for row in rows] for name in rows[0]}) if rows else []
    return "\n".join(lines)


def _row(sensor: ArchivedSensor, *, tables: bool) -> dict[str, str]:
    smallest = (sensor.attrs.get("marker_check") or {}).get("smallest_px", SMALLEST_PX)
    markers = "-"
    if sensor.representation == MASKS:
        markers = str(count_markers(unpack(sensor.references[0]), smallest))
    size = sum(sensor.files.sizes(sensor.path).values()) / 1e6
    shapes, depth, force = "-", "-", ["-"] * 3
    if tables:
        shapes = str(len(np.unique(sensor.table["indenter"])))
        depth = _span(sensor.table["depth"] * 1e3)
        force = [_span(axis) for axis in sensor.table["wrench"][:, :3].T]
    return {
        "sensor": sensor.name,
        "frames": str(len(sensor)),
        "shapes": shapes,
        "refs": str(len(sensor.reference_frames)),
        "markers": markers,
        "MB": f"{size:.2f}",
        "mm/px": f"{sensor.mm_per_px:.4f}",
        "depth mm": depth,
        **dict(zip(("Fx N", "Fy N", "Fz N"), force, strict=True)),
    }


def _span(values: NDArray[np.float64]) -> str:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "-"
    low, high = (round(float(value), 2) + 0.0 for value in (finite.min(), finite.max()))
    return f"{low:.2f} {high:.2f}"  # adding zero turned -0.0 into 0.0
