"""Groups of columns that are written in one go: `targets` and `frames`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.errors import SessionError
from recorder.store.documents import read_document, write_group
from recorder.store.files import LOCAL, Files, sync_tree
from recorder.store.layout import CRC_BYTES, Array, ArrayLayout, ends_with_its_crc
from recorder.store.reader import Kept

_CHUNK_ROWS = 8192


class TableColumn(ArrayLayout):
    """One column of a table: its chunks are files, the last padded with zeros."""

    sharded = False

    def read(self) -> Array:
        """Return all rows; `SessionError` if a chunk is missing or corrupt."""
        chunks = []
        for number in range(-(-self.rows() // self.rows_per_chunk)):
            key = self.shard(number)
            try:
                data = self.files.read(key)
            except FileNotFoundError:
                raise SessionError(f"{self.files.name(key)}: chunk missing") from None
            if not ends_with_its_crc(data):
                name = self.files.name(key)
                raise SessionError(f"{name}: the chunk does not match its checksum")
            chunks.append(self.decoded(data[:-CRC_BYTES]))
        return np.concatenate(chunks)[: self.rows()] if chunks else np.empty(self.shape, self.dtype)


def write_table(
    path: Path,
    columns: Mapping[str, Array],
    units: Mapping[str, tuple[str, str]],
    attrs: Mapping[str, Any] | None = None,
) -> None:
    """Write a new group with one array (n, ...) of equal length per column, durably.

    `units` holds units and description by column, `attrs` the attributes of the group.
    """
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise SessionError(f"{path}: columns of unequal length: {lengths}")
    path.mkdir()
    write_group(path, {**(attrs or {}), "columns": list(columns)})
    for name, values in columns.items():
        column = np.asarray(values)
        dims = ("row", *(f"dim_{axis}" for axis in range(1, column.ndim)))
        layout = TableColumn(
            path / name,
            column.dtype.name,
            column.shape,
            dims,
            *units.get(name, ("1", "")),
            rows_per_chunk=_CHUNK_ROWS,
            chunks_per_shard=1,
        )
        document = layout.document()
        for own in ("zarr_format", "node_type", "storage_transformers"):
            document[own] = document.pop(own)  # in the order of keys that tables have
        layout.path.mkdir()
        (layout.path / "zarr.json").write_text(json.dumps(document, indent=2))
        for number, first in enumerate(range(0, len(column), _CHUNK_ROWS)):
            key = layout.shard(number)
            key.parent.mkdir(parents=True, exist_ok=True)
            key.write_bytes(layout.encoded(column[first : first + _CHUNK_ROWS]))
    sync_tree(path)


def declared_rows(path: Path, files: Files) -> int:
    """Return the number of rows that a column declares, whether or not its chunks are there."""
    shape = read_document(files, path / "zarr.json").get("shape")
    if not isinstance(shape, list) or not shape or type(shape[0]) is not int:
        raise SessionError(f"{files.name(path)}: found shape {shape!r:.200}, expected a list")
    return shape[0]


class Table(Mapping[str, Array]):
    """Columns of a group, read on access; those used last are kept in memory."""

    def __init__(self, path: Path, names: tuple[str, ...], load: Callable[[str], Array]) -> None:
        """Provide the columns `names`, read by `load(name)`."""
        self._path = path
        self._names = names
        self._load = load
        self._read: Kept[Array] = Kept()

    @classmethod
    def of_group(cls, path: Path, files: Files = LOCAL) -> Self:
        """Return the table in a group written by `write_table`; empty if there is none."""
        names = tuple(sorted(entry.name for entry in files.groups(path)))
        if names:
            read_document(files, path / "zarr.json")
        return cls(path, names, partial(_column, files, path))

    def __getitem__(self, name: str) -> Array:
        """Return a column (n, ...)."""
        if name not in self._names:
            raise KeyError(f"{self._path}: no column {name!r}; known: {', '.join(self._names)}")
        found = self._read.get(name)
        return self._read.put(name, self._load(name)) if found is None else found

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._names)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self._names)


def _column(files: Files, path: Path, name: str) -> Array:
    return TableColumn.load(path / name, files).read()
