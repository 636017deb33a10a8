"""Groups of columns that are written in one go: `targets` and `frames`."""

import json
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.documents import read_document
from recorder.store.durable import sync_tree
from recorder.store.files import LOCAL, Files
from recorder.store.journal import CRC_BYTES, ends_with_its_crc, packed_crc
from recorder.store.layout import check_shape, write_group
from recorder.store.recent import Kept

Array = np.ndarray[Any, Any]

_CHUNK_ROWS = 8192


def write_table(
    path: Path,
    columns: Mapping[str, Array],
    units: Mapping[str, tuple[str, str]],
    attrs: Mapping[str, Any] | None = None,
) -> None:
    """Write a new group with one array per column, durably.

    Args:
        path: The group; must not exist.
        columns: Arrays (n, ...) of equal length.
        units: Units and description by column.
        attrs: Attributes of the group.
    """
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise SessionError(f"{path}: columns of unequal length: {lengths}")
    path.mkdir()
    write_group(path, {**(attrs or {}), "columns": list(columns)})
    for name, column in columns.items():
        unit, description = units.get(name, ("1", ""))
        _write_column(path / name, np.asarray(column), {"units": unit, "description": description})
    sync_tree(path)


def _write_column(path: Path, column: Array, attrs: dict[str, Any]) -> None:
    """Write one array: chunks of `_CHUNK_ROWS` rows, the last padded with fill values."""
    dtype = column.dtype.newbyteorder("<")
    chunk_shape = [_CHUNK_ROWS, *column.shape[1:]]
    document = {
        "shape": list(column.shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk_shape}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": np.zeros((), dtype).item(),
        "codecs": [
            {"name": "bytes", "configuration": {"endian": "little"}},
            {"name": "zstd", "configuration": {"level": images.ZSTD_LEVEL, "checksum": False}},
            {"name": "crc32c"},
        ],
        "attributes": attrs,
        "dimension_names": ["row", *(f"dim_{axis}" for axis in range(1, column.ndim))],
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }
    path.mkdir()
    (path / "zarr.json").write_text(json.dumps(document, indent=2))
    for number, first in enumerate(range(0, len(column), _CHUNK_ROWS)):
        rows = column[first : first + _CHUNK_ROWS]
        chunk = np.zeros(chunk_shape, dtype)
        chunk[: len(rows)] = rows
        data = images.compress(chunk.data.cast("B"))
        key = path.joinpath("c", str(number), *("0" for _ in column.shape[1:]))
        key.parent.mkdir(parents=True, exist_ok=True)
        key.write_bytes(data + packed_crc(data))


def declared_rows(path: Path, files: Files) -> int:
    """Return the number of rows that a column declares, whether or not its chunks are there."""
    shape = read_document(files, path / "zarr.json").get("shape")
    if not isinstance(shape, list) or not shape or type(shape[0]) is not int:
        raise SessionError(f"{files.name(path)}: found shape {shape!r:.200}, expected a list")
    return shape[0]


def _column(files: Files, path: Path, name: str) -> Array:
    """Return all rows of a column; `SessionError` if a chunk is missing or corrupt."""
    array = path / name
    where = files.name(array)
    document = read_document(files, array / "zarr.json")
    try:
        shape, dtype = document["shape"], np.dtype(document["data_type"]).newbyteorder("<")
        check_shape(shape, document["data_type"], where)
        if dtype.kind not in "biuf":
            raise SessionError(f"{where}: found data_type {dtype.name}; allowed: numbers")
        chunk_shape = document["chunk_grid"]["configuration"]["chunk_shape"]
        codecs = [codec["name"] for codec in document["codecs"]]
    except (KeyError, TypeError, ValueError) as error:
        raise SessionError(f"{where}: not a column of a table: {error!r}") from error
    if codecs != ["bytes", "zstd", "crc32c"]:
        raise SessionError(f"{where}: found codecs {codecs}, expected bytes, zstd, crc32c")
    if chunk_shape != [_CHUNK_ROWS, *shape[1:]]:
        raise SessionError(f"{where}: found chunk_shape {chunk_shape} of shape {shape}")
    nbytes = math.prod(chunk_shape) * dtype.itemsize
    chunks = []
    for number in range(-(-shape[0] // _CHUNK_ROWS)):
        key = array.joinpath("c", str(number), *("0" for _ in shape[1:]))
        try:
            data = files.read(key)
        except FileNotFoundError:
            raise SessionError(f"{files.name(key)}: chunk missing") from None
        try:
            plain = images.decompress(_without_crc(data), nbytes)
        except SessionError as error:
            raise SessionError(f"{files.name(key)}: {error}") from error
        chunks.append(np.frombuffer(plain, dtype).reshape(chunk_shape))
    return np.concatenate(chunks)[: shape[0]] if chunks else np.empty(shape, dtype)


def _without_crc(data: bytes) -> bytes:
    if not ends_with_its_crc(data):
        raise SessionError("the chunk does not match its checksum")
    return data[:-CRC_BYTES]


class Table(Mapping[str, Array]):
    """Columns of a group, read on access; those used last are kept in memory."""

    def __init__(self, path: Path, names: tuple[str, ...], load: Any) -> None:
        """Provide the columns `names`, read by `load(name)`."""
        self._path = path
        self._names = names
        self._load = load
        self._read: Kept[Array] = Kept()

    @classmethod
    def of_group(cls, path: Path, files: Files = LOCAL) -> "Table":
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
