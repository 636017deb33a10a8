"""Groups of columns that are written in one go: `targets` and `frames`."""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from recorder.errors import SessionError
from recorder.store.files import LOCAL, Files
from recorder.store.layout import write_group

Array = np.ndarray[Any, Any]

_CHUNK_ROWS = 8192


def write_table(
    path: Path,
    columns: Mapping[str, Array],
    units: Mapping[str, tuple[str, str]],
    attrs: Mapping[str, Any] | None = None,
) -> None:
    """Write a new group with one array per column.

    Args:
        path: The group; must not exist.
        columns: Arrays (n, ...) of equal length.
        units: Units and description by column.
        attrs: Attributes of the group.

    Raises:
        SessionError: Columns of unequal length.
    """
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise SessionError(f"{path}: columns of unequal length: {lengths}")
    path.mkdir()
    write_group(path, dict(attrs or {}))
    for name, column in columns.items():
        unit, description = units.get(name, ("1", ""))
        array = zarr.create_array(
            path / name,
            shape=column.shape,
            dtype=column.dtype,
            chunks=(_CHUNK_ROWS, *column.shape[1:]),
            compressors=ZstdCodec(level=1, checksum=True),
            dimension_names=["row", *(f"dim_{axis}" for axis in range(1, column.ndim))],
            attributes={"units": unit, "description": description},
            config={"write_empty_chunks": True},
        )
        if len(column):
            array[...] = column


def _column(files: Files, path: Path, name: str) -> Array:
    return np.asarray(files.array(path / name))


class Table(Mapping[str, Array]):
    """Columns of a group, read on first access."""

    def __init__(self, path: Path, names: tuple[str, ...], load: Any) -> None:
        """Provide the columns `names`, read by `load(name)`."""
        self._path = path
        self._names = names
        self._load = load
        self._read: dict[str, Array] = {}

    @classmethod
    def of_group(cls, path: Path, files: Files = LOCAL) -> "Table":
        """Return the table in a group written by `write_table`; empty if there is none."""
        names = tuple(sorted(entry.name for entry in files.groups(path)))
        return cls(path, names, partial(_column, files, path))

    def __getitem__(self, name: str) -> Array:
        """Return a column (n, ...).

        Raises:
            KeyError: No such column.
        """
        if name not in self._names:
            raise KeyError(f"{self._path}: no column {name!r}; known: {', '.join(self._names)}")
        if name not in self._read:
            self._read[name] = self._load(name)
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._names)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self._names)
