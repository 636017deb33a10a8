"""Arrays of an archive: frames by their representation, and the columns of a sensor's table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.markers import PACKED
from recorder.spec import PHASES
from recorder.store.files import replace_file
from recorder.store.layout import Array, ArrayLayout, packed_index

# Side of a shading image, and its value where nothing changed.
SHADING_SIDE, SHADING_ZERO = 128, 128


@dataclass(frozen=True, slots=True)
class Representation:
    """One row a representation: all that differs on disk."""

    name: str
    """Name, stored as the sensor's attribute `representation`; sensors without one hold masks."""
    array: str
    """Array of the frames."""
    shape: tuple[int, ...]
    """Shape of one frame, uint8."""
    dims: tuple[str, ...]
    """Dimension names of one frame."""
    description: str
    """One sentence for readers who have only the array."""
    reference: str
    """The same for `references`."""


MASKS = Representation(
    "masks",
    "markers",
    (PACKED,),
    ("byte",),
    "mask of 480 x 640 pixels, row-major, first pixel in the highest bit, 1 = marker",
    "masks of the untouched sensor, packed as markers are",
)
SHADING = Representation(
    "shading",
    "shading",
    (3, SHADING_SIDE, SHADING_SIDE),
    ("colour", "y", "x"),
    "red, green, blue minus those of the untouched sensor, plus 128, cut to 0 to 255; each pixel "
    "the mean over a cell of the camera's image",
    "red, green, blue of the untouched sensor",
)
REPRESENTATIONS: Mapping[str, Representation] = {each.name: each for each in (MASKS, SHADING)}


@dataclass(frozen=True)
class ArchiveArray(ArrayLayout):
    """One array of an archive, of fixed length.

    A shard is written in one go under a name unique to its writer, made durable and then renamed.
    """

    level: int = 3
    """Level of zstd for new chunks; any is read."""

    # All shards are in one directory: one name to make durable, not a path.
    separator = "."
    # No manifest has a checksum of an archive's metadata.
    compared = (
        *ArrayLayout.compared,
        *("zarr_format", "fill_value", "storage_transformers", "attributes"),
    )

    @property
    def shards(self) -> int:
        """Number of shards."""
        return math.ceil(self.rows() / self.rows_per_shard)

    def rows_of_shard(self, number: int) -> slice:
        """Return the rows in a shard."""
        first = number * self.rows_per_shard
        return slice(first, min(first + self.rows_per_shard, self.rows()))

    def write_shard(self, number: int, values: Array) -> None:
        """Write all rows of a shard; equal rows give equal bytes."""
        rows = self.rows_of_shard(number)
        due = (rows.stop - rows.start, *self.shape[1:])
        if values.shape != due or values.dtype != self.dtype:
            raise SessionError(
                f"{self.path}: found {values.dtype} {values.shape} for shard {number}, "
                f"expected {self.data_type} {due}"
            )
        step = self.rows_per_chunk
        chunks = [self.encoded(values[first : first + step]) for first in range(0, due[0], step)]
        ends = np.cumsum([len(chunk) for chunk in chunks]).tolist()
        entries = [(end - len(chunk), len(chunk)) for end, chunk in zip(ends, chunks, strict=True)]
        data = b"".join((*chunks, packed_index(entries, self.chunks_per_shard)))
        replace_file(self.shard(number), data, several=True)

    def write_whole(self, values: Array) -> None:
        """Write an array of one shard, replacing any existing."""
        self.create()
        self.write_shard(0, values)


# The table of a sensor: metadata of each frame, with its columns and their allowed values.

# The column that the writer fills: it indexes the provenance lines.
SOURCE = "source"
# Code of a frame that belongs to no phase.
NO_PHASE = -1

_CHUNK_ROWS = 4096


@dataclass(frozen=True, slots=True)
class ColumnKind:
    """One column of a table."""

    dtype: str
    """Zarr data type."""
    units: str
    """Units as stored."""
    description: str
    """One sentence for readers who have only the array."""
    shape: tuple[int, ...] = ()
    """Shape of one value."""
    dims: tuple[str, ...] = ()
    """Dimension names of one value."""
    least: int | None = None
    """Smallest allowed value of an integer column."""
    may_be_nan: bool = False
    """True if NaN is allowed, in all of a row's values or none."""


# Columns of a table, in order.
COLUMNS: Mapping[str, ColumnKind] = {
    "indenter": ColumnKind("int16", "1", "code of the indenter, see attrs names", least=0),
    "seen": ColumnKind("bool", "1", "whether models may be trained on the indenter"),
    "location": ColumnKind(
        "int32",
        "1",
        "equal in rows of two sensors that were pressed at the same place; -1: at none",
        least=-1,
    ),
    "target": ColumnKind("int16", "1", "number of the target within the indenter", least=0),
    "phase": ColumnKind("int8", "1", "code of the phase, see attrs names; -1: none", least=-1),
    "depth": ColumnKind("float64", "m", "commanded indentation"),
    "position": ColumnKind(
        "float64",
        "m",
        "indenter in the contact frame, x to the right and y up in the image",
        (2,),
        ("axis",),
    ),
    "wrench": ColumnKind(
        "float64",
        "N, N m",
        "Fx Fy Fz [N], Tx Ty Tz [N m]; pressing is negative Fz; NaN without a label",
        (6,),
        ("axis",),
        may_be_nan=True,
    ),
    "frame": ColumnKind("int32", "1", "number of the frame within its target", least=0),
    "t_ns": ColumnKind("int64", "ns", "time of the frame, on the clock of its source"),
    "reference": ColumnKind("int16", "1", "row of references", least=0),
    "valid": ColumnKind(
        "bool", "1", "whether there is such a frame; where not, its source says why"
    ),
    SOURCE: ColumnKind("int32", "1", "row of sources", least=0),
}

# Columns that a simulation may add to a complete archive (`write_simulated`).
SIMULATED: Mapping[str, ColumnKind] = {
    name: ColumnKind("float64", "N", description, (3,), ("axis",), may_be_nan=True)
    for name, description in (
        ("simulated", "Fx Fy Fz that a twin of the sensor gives in the frame's press; NaN: none"),
        ("simulated_spread", "standard deviation of these forces by the twin's uncertainty"),
    )
}

# Columns that the caller of the writer supplies.
GIVEN = tuple(name for name in COLUMNS if name != SOURCE)


@dataclass(frozen=True, slots=True)
class Limits:
    """Numbers of entries that codes may refer to."""

    indenters: int
    references: int
    sources: int | None = None
    """None while provenance lines are still being collected."""

    def of(self, name: str) -> int | None:
        """Return the exclusive upper limit of a column's values; None if there is none."""
        ends = {"indenter": self.indenters, "reference": self.references, SOURCE: self.sources}
        return ends.get(name, len(PHASES) if name == "phase" else None)


def checked_columns(
    table: Mapping[str, Any], rows: int, limits: Limits, where: str
) -> dict[str, Array]:
    """Return the columns of `GIVEN`, one value per row, as arrays of the table's types.

    `where` is the prefix of messages.
    """
    if set(table) != set(GIVEN):
        raise SessionError(
            f"{where}: found columns {', '.join(sorted(table))}; expected {', '.join(GIVEN)}"
        )
    columns = {}
    for name in GIVEN:
        columns[name] = _typed(table[name], COLUMNS[name], rows, f"{where}.{name}")
        wrong = np.flatnonzero(misplaced(name, columns[name], limits))
        if wrong.size:
            found = f"found {columns[name][wrong[0]]} in row {wrong[0]}"
            raise SessionError(f"{where}.{name}: {found}; allowed: {allowed(name, limits)}")
    return columns


def misplaced(name: str, values: Array, limits: Limits) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows of a column whose values are not allowed."""
    column, wrong = COLUMNS[name], np.zeros(len(values), np.bool_)
    if values.dtype.kind == "f":
        values = values.reshape(len(values), -1)
        fine = ~np.isinf(values) if column.may_be_nan else np.isfinite(values)
        return np.asarray(wrong | ~fine.all(axis=1), np.bool_)
    end = limits.of(name)
    if column.least is not None:
        wrong |= values < column.least
    if end is not None:
        wrong |= values >= end
    return wrong


def allowed(name: str, limits: Limits) -> str:
    """Return the allowed values of a column as text."""
    column, end = COLUMNS[name], limits.of(name)
    if column.dtype.startswith("float"):
        return "finite values" + ", or NaN" * column.may_be_nan
    return f"{column.least} " + ("and more" if end is None else f"to {end - 1}")


def column_array(
    path: Path, rows: int, names: Sequence[str] = (), attrs: Mapping[str, Any] | None = None
) -> ArchiveArray:
    """Return the array of a column of `COLUMNS` or `SIMULATED`, named by its path: one file.

    `rows` is the length of the table, `names` are those of the codes, in order.
    """
    column = {**COLUMNS, **SIMULATED}[path.name]
    return ArchiveArray(
        path,
        column.dtype,
        (rows, *column.shape),
        ("row", *column.dims),
        column.units,
        column.description,
        _CHUNK_ROWS,
        -(-rows // _CHUNK_ROWS),
        ({"names": list(names)} if names else {}) | dict(attrs or {}),
    )


def _typed(values: Any, column: ColumnKind, rows: int, where: str) -> Array:
    dtype, due = np.dtype(column.dtype), (rows, *column.shape)
    array = np.asarray(values)
    found = f"{array.dtype} {array.shape}"
    if array.shape != due or not _same_kind(array.dtype, dtype):
        raise SessionError(f"{where}: found {found}, expected {column.dtype} {due}")
    if dtype.kind == "i" and array.size:
        limits = np.iinfo(dtype)
        if int(array.min()) < limits.min or int(array.max()) > limits.max:
            raise SessionError(
                f"{where}: found values from {array.min()} to {array.max()}, out of range for "
                f"{column.dtype}"
            )
    return array.astype(dtype.newbyteorder("<"))


def _same_kind(found: np.dtype[Any], due: np.dtype[Any]) -> bool:
    """Return True if every value survives the conversion, up to rounding and range."""
    return found.kind in {"b": "b", "i": "iu", "f": "iuf"}[due.kind]
