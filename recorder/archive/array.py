"""One array of a marker archive on disk: rows in chunks, chunks in shards, one file per shard.

A shard is written in one go under a name unique to its writer, made durable and then renamed.
All codecs are core Zarr v3: `sharding_indexed` over `bytes`, `zstd` and `crc32c`.
"""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Self

import google_crc32c
import numcodecs.zstd
import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.store.documents import read_document
from recorder.store.durable import TEMPORARY, replace_file, write_json
from recorder.store.files import LOCAL, Files
from recorder.store.images import decompress
from recorder.store.journal import CRC_BYTES
from recorder.store.shard import MISSING, Index, packed_index, read_index

Array = np.ndarray[Any, Any]

ZSTD_LEVEL = 3


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """Specification of an array, independent of its path."""

    dtype: str
    """Zarr data type, e.g. `float64`."""
    shape: tuple[int, ...]
    """Number of rows, then the shape of one."""
    dims: tuple[str, ...]
    """Dimension names, the first being `row`."""
    units: str
    """Units as stored; `1` for a pure number."""
    description: str
    """One sentence for readers who have only the array."""
    chunk_rows: int
    """Rows per chunk, compressed together."""
    shard_rows: int
    """Rows per file, a multiple of `chunk_rows`."""
    attrs: Mapping[str, Any] = field(default_factory=dict)
    """Further attributes stored with it."""

    def document(self) -> dict[str, Any]:
        """Return the array's Zarr v3 metadata."""
        inner = [self.chunk_rows, *self.shape[1:]]
        outer = [self.shard_rows, *self.shape[1:]]
        little = {"name": "bytes", "configuration": {"endian": "little"}}
        zstd = {"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}}
        sharding = {
            "chunk_shape": inner,
            "codecs": [little, zstd, {"name": "crc32c"}],
            "index_codecs": [little, {"name": "crc32c"}],
            "index_location": "end",
        }
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.dtype,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": outer}},
            # With dots all shards are in one directory: one name to make durable, not a path.
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
            "fill_value": _fill_value(self.dtype),
            "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
            "attributes": {
                "units": self.units,
                "description": self.description,
                **self.attrs,
            },
            "dimension_names": list(self.dims),
            "storage_transformers": [],
        }


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """An array at a path."""

    path: Path
    """Directory of the array."""
    spec: ArraySpec
    """Specification of the array."""
    files: Files = field(default=LOCAL, repr=False, compare=False)
    """File access for the directory."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Little-endian numpy type."""
        return np.dtype(self.spec.dtype).newbyteorder("<")

    @property
    def rows(self) -> int:
        """Declared length."""
        return self.spec.shape[0]

    @property
    def slots(self) -> int:
        """Chunks per full shard."""
        return self.spec.shard_rows // self.spec.chunk_rows

    @property
    def shards(self) -> int:
        """Number of shards."""
        return math.ceil(self.rows / self.spec.shard_rows)

    @property
    def chunks(self) -> int:
        """Number of chunks that contain rows."""
        return math.ceil(self.rows / self.spec.chunk_rows)

    @property
    def chunk_shape(self) -> tuple[int, ...]:
        """Shape of a decoded chunk."""
        return (self.spec.chunk_rows, *self.spec.shape[1:])

    def shard(self, number: int) -> Path:
        """Return the path of a shard."""
        return self.path / f"c.{number}{'.0' * (len(self.spec.shape) - 1)}"

    def rows_of_shard(self, number: int) -> slice:
        """Return the rows in a shard."""
        first = number * self.spec.shard_rows
        return slice(first, min(first + self.spec.shard_rows, self.rows))

    def create(self) -> None:
        """Write the metadata, replacing any existing."""
        self.path.mkdir(exist_ok=True)
        write_json(self.path / "zarr.json", self.spec.document())

    def write_shard(self, number: int, values: Array) -> None:
        """Write all rows of a shard; equal rows give equal bytes."""
        rows = self.rows_of_shard(number)
        due = (rows.stop - rows.start, *self.spec.shape[1:])
        if values.shape != due or values.dtype != self.dtype:
            raise SessionError(
                f"{self.path}: found {values.dtype} {values.shape} for shard {number}, "
                f"expected {self.spec.dtype} {due}"
            )
        step = self.spec.chunk_rows
        chunks = [
            self._encoded(values[first : first + step]) for first in range(0, len(values), step)
        ]
        ends = np.cumsum([len(chunk) for chunk in chunks]).tolist()
        entries = [(end - len(chunk), len(chunk)) for end, chunk in zip(ends, chunks, strict=True)]
        data = b"".join((*chunks, packed_index(entries, self.slots)))
        path = self.shard(number)
        replace_file(path, data, temporary=own_temporary(path))

    def decoded(self, data: bytes) -> Array:
        """Return the rows of a chunk (chunk_rows, ...), padding of the last one included."""
        body, crc = data[:-CRC_BYTES], data[-CRC_BYTES:]
        if int(google_crc32c.value(body)) != int.from_bytes(crc, "little"):
            raise SessionError(f"{self.files.name(self.path)}: checksum of a chunk does not match")
        try:
            plain = decompress(body, math.prod(self.chunk_shape) * self.dtype.itemsize)
        except SessionError as error:
            raise SessionError(f"{self.files.name(self.path)}: {error}") from error
        return np.frombuffer(plain, self.dtype).reshape(self.chunk_shape)

    def _encoded(self, rows: Array) -> bytes:
        if len(rows) < self.spec.chunk_rows:
            whole = np.zeros(self.chunk_shape, self.dtype)
            whole[: len(rows)] = rows
            rows = whole
        body: bytes = numcodecs.zstd.compress(np.ascontiguousarray(rows).tobytes(), ZSTD_LEVEL)
        return body + int(google_crc32c.value(body)).to_bytes(CRC_BYTES, "little")

    @classmethod
    def load(cls, path: Path, files: Files = LOCAL) -> Self:
        """Return the layout described by an array's metadata."""
        document = read_document(files, path / "zarr.json")
        where = files.name(path)
        try:
            (sharding,) = (codec["configuration"] for codec in document["codecs"])
            attributes = dict(document["attributes"])
            spec = ArraySpec(
                document["data_type"],
                tuple(document["shape"]),
                tuple(document["dimension_names"]),
                attributes.pop("units", ""),
                attributes.pop("description", ""),
                sharding["chunk_shape"][0],
                document["chunk_grid"]["configuration"]["chunk_shape"][0],
                attributes,
            )
            if spec.chunk_rows < 1 or spec.shard_rows % spec.chunk_rows:
                raise ValueError(f"chunks of {spec.chunk_rows} in shards of {spec.shard_rows}")
            expected = spec.document()
            found = {key: document[key] for key in expected if key != "attributes"}
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise SessionError(f"{where}: not an array of an archive: {error!r}") from error
        for key, value in found.items():
            if value != expected[key]:
                raise SessionError(f"{where}: found {key} {value}, expected {expected[key]}")
        return cls(path, spec, files)


def own_temporary(path: Path) -> Path:
    """Return a name in the same directory that no other writer of the file uses."""
    return path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}{TEMPORARY}")


def _fill_value(dtype: str) -> Any:
    # Use NaN as the fill value if the type allows it, so that missing data is recognisable.
    if dtype == "bool":
        return False
    return "NaN" if dtype.startswith("float") else 0


# Reading rows of an archive's array directly from its shards, local or remote.
#
# A chunk that is declared but missing is an error here; a plain Zarr reader returns fill values.

Rows = Sequence[int] | NDArray[np.integer[Any]] | slice


class ArrayReader:
    """Reader of one array. Holds no file open, so that it can be forked, pickled and copied."""

    def __init__(self, layout: ArrayLayout) -> None:
        """Prepare reading; shards are opened only when needed."""
        self.layout = layout
        self._indices: dict[int, Index] = {}

    def __len__(self) -> int:
        """Return the declared number of rows."""
        return self.layout.rows

    def all(self) -> Array:
        """Return all rows (n, ...)."""
        return self.read(slice(None))

    def read(self, rows: Rows) -> Array:
        """Return some rows (n, ...) in the requested order; each chunk is decoded once."""
        numbers = self._numbers(rows)
        out = np.empty((len(numbers), *self.layout.spec.shape[1:]), self.layout.dtype)
        chunk, within = np.divmod(numbers, self.layout.spec.chunk_rows)
        order = np.argsort(chunk, kind="stable")
        wanted, first = np.unique(chunk[order], return_index=True)
        rows_of = dict(zip(wanted.tolist(), np.split(order, first[1:]), strict=False))
        for shard, group in groupby(wanted.tolist(), lambda number: number // self.layout.slots):
            chunks = list(group)
            fetched = self.fetch(shard, [number % self.layout.slots for number in chunks])
            for number, data in zip(chunks, fetched, strict=True):
                here = rows_of[number]
                out[here] = self.layout.decoded(data)[within[here]]
        return out

    def fetch(self, shard: int, places: Sequence[int]) -> list[bytes]:
        """Return encoded chunks of one shard."""
        files, path = self.layout.files, self.layout.shard(shard)
        if shard not in self._indices:
            self._indices[shard] = read_index(path, files, self.layout.slots)
        wanted = [(int(offset), int(size)) for offset, size in self._indices[shard][list(places)]]
        for place, (offset, _) in zip(places, wanted, strict=True):
            if offset == MISSING:
                raise SessionError(f"{files.name(path)}: chunk {place} is missing")
        try:
            found = files.ranges(path, wanted)
        except FileNotFoundError:
            raise SessionError(f"{files.name(path)}: shard missing") from None
        for place, (_, size), data in zip(places, wanted, found, strict=True):
            if len(data) != size:
                raise SessionError(f"{files.name(path)}: chunk {place} is cut short")
        return found

    def _numbers(self, rows: Rows) -> NDArray[np.int64]:
        if isinstance(rows, slice):
            return np.arange(len(self), dtype=np.int64)[rows]
        numbers = np.asarray(rows)
        where = self.layout.files.name(self.layout.path)
        if numbers.ndim != 1 or (numbers.size and numbers.dtype.kind not in "iu"):
            raise SessionError(
                f"{where}: found rows {numbers.dtype} {numbers.shape}, expected integers (n,)"
            )
        wrong = numbers[(numbers < 0) | (numbers >= len(self))]
        if wrong.size:
            raise SessionError(f"{where}: no row {wrong[0]}, the array has {len(self)}")
        return numbers.astype(np.int64)
