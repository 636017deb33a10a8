"""Layout on disk: Zarr v3 arrays of rows, and streams of columns with the journal of their rows.

Rows are compressed together in chunks of equal length, each followed by its CRC-32C, and the chunks
of a shard share a file, `c/<shard>/0/...`. The columns of streams and tables and the arrays of a
marker archive are such arrays. All codecs are core Zarr v3, except that of JPEG images.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from recorder.errors import SessionError
from recorder.spec import Column, StreamSpec
from recorder.store import documents, images
from recorder.store.files import LOCAL, TEMPORARY, Files
from recorder.store.records import CRC_BYTES, ends_with_its_crc, packed_crc

Array = np.ndarray[Any, Any]

MISSING = 0xFFFF_FFFF_FFFF_FFFF

# Largest metadata accepted, so that a corrupt or hostile file cannot make a reader allocate memory.
SIDE_MAX = 1 << 16
ROW_BYTES_MAX = CHUNK_BYTES_MAX = 1 << 27
# Largest number of inner chunks per shard that is read.
CHUNKS_MAX = 1 << 16

_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c"}


@dataclass(frozen=True, slots=True, weakref_slot=True)
class ShardIndex:
    """Places of the chunks of a shard."""

    ranges: list[tuple[int, int]]
    """Offset and length of each chunk; both are `MISSING` if there is none."""
    crcs: list[int] | None
    """Checksum of each chunk; None if the shard does not list them."""

    @property
    def nbytes(self) -> int:
        """Memory that it takes, as Python's numbers [bytes]."""
        return 200 * len(self.ranges)

    @property
    def chunks(self) -> int:
        """Number of chunks before the first missing one."""
        gaps = (index for index, (offset, _) in enumerate(self.ranges) if offset == MISSING)
        return next(gaps, len(self.ranges))


def packed_index(entries: list[tuple[int, int]], slots: int) -> bytes:
    """Return the bytes that end a shard: offset and length per slot, and their checksum."""
    index = np.full((slots, 2), MISSING, "<u8")
    index[: len(entries)] = np.array(entries, "<u8").reshape(-1, 2)
    data = index.tobytes()
    return data + packed_crc(data)


@dataclass(frozen=True)
class ArrayLayout:
    """One array on disk; its subclasses are the ways in which the recorder stores one."""

    path: Path
    """Directory of the array."""
    data_type: str
    """Zarr data type, e.g. `float64`."""
    shape: tuple[int, ...]
    """Number of rows, then the shape of one."""
    dims: tuple[str, ...]
    """Dimension names, the first being `row`."""
    units: str
    """Units as stored; `1` for a pure number."""
    description: str
    """One sentence for readers who have only the array."""
    rows_per_chunk: int
    """Rows per chunk, compressed together; 1 for images."""
    chunks_per_shard: int
    """Chunks per full shard."""
    attrs: Mapping[str, Any] = field(default_factory=dict)
    """Further attributes."""
    codec: str = "zstd"
    """`zstd`, or `jpeg` for images stored as JPEG."""
    level: int = images.ZSTD_LEVEL
    """Level of zstd for new chunks; any is read."""
    files: Files = field(default=LOCAL, repr=False, compare=False)
    """File access for the directory."""

    separator: ClassVar[str] = "/"
    """Separator in the names of shards."""
    sharded: ClassVar[bool] = True
    """False if each chunk is a file of its own."""
    compared: ClassVar[tuple[str, ...]] = (
        "node_type",
        "chunk_grid",
        "chunk_key_encoding",
        "codecs",
    )
    """Keys of the metadata that must be as this class writes them."""
    lists_crcs: ClassVar[bool] = False
    """True if a shard lists the checksums of its chunks before its index."""

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Little-endian numpy type."""
        return np.dtype(self.data_type).newbyteorder("<")

    @property
    def rows_per_shard(self) -> int:
        """Rows per full shard."""
        return self.rows_per_chunk * self.chunks_per_shard

    @cached_property
    def chunk_shape(self) -> tuple[int, ...]:
        """Shape of a decoded chunk."""
        return (self.rows_per_chunk, *self.shape[1:])

    @cached_property
    def chunk_bytes(self) -> int:
        """Size of a decoded chunk [bytes]."""
        return math.prod(self.chunk_shape) * self.dtype.itemsize

    @property
    def end_bytes(self) -> int:
        """Length of the end of a shard: checksums, if listed, and index [bytes]."""
        return (16 + CRC_BYTES * self.lists_crcs) * self.chunks_per_shard + CRC_BYTES

    def rows(self) -> int:
        """Return the declared length."""
        return self.shape[0]

    def shard(self, number: int) -> Path:
        """Return the path of a shard."""
        parts = ["c", str(number), *("0" for _ in self.shape[1:])]
        return self.path / self.separator.join(parts)

    def create(self, *, durable: bool = True) -> None:
        """Write the metadata, replacing any existing."""
        self.path.mkdir(exist_ok=True)
        documents.write_json(self.path / "zarr.json", self.document(), durable=durable)

    def document(self) -> dict[str, Any]:
        """Return the array's Zarr v3 metadata."""
        configuration = {"level": self.level, "checksum": False}
        codecs: list[dict[str, Any]] = [_LITTLE, {"name": "zstd", "configuration": configuration}]
        if self.codec == "jpeg":
            configuration = {"level": images.JPEG_QUALITY}
            codecs = [{"name": images.NAME, "configuration": configuration}]
        codecs.append(_CRC)
        if self.sharded:
            sharding = {
                "chunk_shape": list(self.chunk_shape),
                "codecs": codecs,
                "index_codecs": [_LITTLE, _CRC],
                "index_location": "end",
            }
            codecs = [{"name": "sharding_indexed", "configuration": sharding}]
        # Missing data are recognisable in shards: NaN if the type allows it.
        is_nan = self.sharded and self.data_type.startswith("float")
        grid = [self.rows_per_shard, *self.shape[1:]]
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.data_type,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": grid}},
            "chunk_key_encoding": {
                "name": "default",
                "configuration": {"separator": self.separator},
            },
            "fill_value": "NaN" if is_nan else np.zeros((), self.dtype).item(),
            "codecs": codecs,
            "attributes": {"units": self.units, "description": self.description, **self.attrs},
            "dimension_names": list(self.dims),
            "storage_transformers": [],
        }

    @classmethod
    def load(cls, path: Path, files: Files = LOCAL) -> Self:
        """Return the layout described by an array's metadata."""
        document = documents.read_document(files, path / "zarr.json")
        name = files.name(path)
        try:
            layout = cls._described(path, files, document)
            expected = layout.document()
            stored = {key: document[key] for key in cls.compared}
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise SessionError(f"{name}: not an array of this format: {error!r}") from error
        for key, value in stored.items():
            if _without_level(value) != _without_level(expected[key]):
                raise SessionError(f"{name}: found {key} {value}, expected {expected[key]}")
        return layout

    @classmethod
    def _described(cls, path: Path, files: Files, document: dict[str, Any]) -> Self:
        name = files.name(path)
        shape, data_type = document["shape"], document["data_type"]
        check_shape(shape, data_type, name)
        per_shard = document["chunk_grid"]["configuration"]["chunk_shape"][0]
        inner, codecs = [per_shard, *shape[1:]], document["codecs"]
        if cls.sharded:
            (sharding,) = (codec["configuration"] for codec in codecs)
            inner, codecs = sharding["chunk_shape"], sharding["codecs"]
        row_bytes = math.prod(shape[1:]) * np.dtype(data_type).itemsize
        if type(inner[0]) is not int or not 0 < inner[0] * row_bytes <= CHUNK_BYTES_MAX:
            raise SessionError(
                f"{name}: found chunk_shape {inner}; allowed: up to {CHUNK_BYTES_MAX} bytes"
            )
        most = CHUNKS_MAX * inner[0]
        if type(per_shard) is not int or not inner[0] <= per_shard <= most:
            raise SessionError(
                f"{name}: found {per_shard!r:.80} rows per shard; allowed: {inner[0]} to {most}"
            )
        attributes = dict(document.get("attributes", {}))
        return cls(
            path,
            data_type,
            tuple(shape),
            tuple(document["dimension_names"]),
            attributes.pop("units", ""),
            attributes.pop("description", ""),
            inner[0],
            per_shard // inner[0],
            attributes,
            "jpeg" if codecs[0]["name"] == images.NAME else "zstd",
            files=files,
        )

    def encoded(self, rows: Array) -> bytes:
        """Return rows (n, ...), at most those of a chunk, as one; it is padded with zeros."""
        if len(rows) < self.rows_per_chunk:
            whole = np.zeros(self.chunk_shape, self.dtype)
            whole[: len(rows)] = rows
            rows = whole
        data = images.compress(np.ascontiguousarray(rows).tobytes(), self.level)
        return data + packed_crc(data)

    def decoded(self, data: bytes) -> Array:
        """Return the rows (rows_per_chunk, ...) of a chunk without its checksum."""
        try:
            plain = images.decompress(data, self.chunk_bytes)
        except SessionError as error:
            raise SessionError(f"{self.files.name(self.path)}: {error}") from error
        return np.frombuffer(plain, self.dtype).reshape(self.chunk_shape)

    def index(self, number: int) -> ShardIndex:
        """Return the index of a sealed shard."""
        path, slots = self.shard(number), self.chunks_per_shard
        name = self.files.name(path)
        try:
            end = self.files.tail(path, self.end_bytes)
        except FileNotFoundError:
            raise SessionError(f"{name}: shard missing") from None
        if len(end) != self.end_bytes:
            raise SessionError(f"{name}: {len(end)} bytes, too short for a shard index")
        index = end[-16 * slots - CRC_BYTES :]
        if not ends_with_its_crc(index):
            raise SessionError(f"{name}: checksum of the shard index does not match")
        entries = np.frombuffer(index[:-CRC_BYTES], "<u8").reshape(slots, 2)
        ranges = list(zip(*entries.T.tolist(), strict=True))
        crcs = np.frombuffer(end[: CRC_BYTES * slots], "<u4").tolist() if self.lists_crcs else None
        return ShardIndex(ranges, crcs)


def check_shape(shape: object, data_type: str, where: str) -> None:
    """Reject the shape or type of an array that nobody has, before anything is allocated for it."""
    dtype = np.dtype(data_type)
    if dtype.kind not in "biuf":
        raise SessionError(f"{where}: found data_type {dtype.name}; allowed: numbers")
    if (
        not isinstance(shape, list)
        or not shape
        or not all(type(length) is int for length in shape)
        or not 0 <= shape[0] <= documents.ROWS_MAX
        or not all(0 < length <= SIDE_MAX for length in shape[1:])
        or math.prod(shape[1:]) * dtype.itemsize > ROW_BYTES_MAX
    ):
        raise SessionError(
            f"{where}: found shape {shape!r:.200}; allowed: up to {documents.ROWS_MAX} rows, each "
            f"with sides up to {SIDE_MAX} and {ROW_BYTES_MAX} bytes"
        )


def _without_level(value: Any) -> Any:
    """Return codecs without their levels, whole numbers that matter to writers only."""
    if isinstance(value, list):
        return [_without_level(each) for each in value]
    if isinstance(value, dict):
        return {
            key: _without_level(each)
            for key, each in value.items()
            if key != "level" or type(each) is not int
        }
    return value


# Streams: an array per column, and the journal of the rows that are not in it.

# Chunks per shard of new columns. Sealing costs the same for every shard; the shards of JPEG
# images would be small and many otherwise.
CHUNKS_PER_SHARD = 64
JPEGS_PER_SHARD = 512
# Chunks per shard of the other columns of a stream of JPEG images, whose blocks are larger.
BLOCKS_PER_JPEG_SHARD = 16
# Suffix of a shard that is still growing; Zarr readers ignore it.
PARTIAL = ".partial"
# Reserved space on disk for a stream being written, so that it can be closed on a full disk.
RESERVED = "reserved"


class ColumnLayout(ArrayLayout):
    """One column of a stream on disk, whose declared length grows."""

    lists_crcs = True

    @classmethod
    def of(cls, path: Path, column: Column, rows_per_chunk: int, chunks_per_shard: int) -> Self:
        """Return the layout of a new column."""
        dims = column.dims or tuple(f"dim_{axis + 1}" for axis in range(len(column.shape)))
        return cls(
            path,
            column.dtype,
            (0, *column.shape),
            ("row", *dims),
            column.units,
            column.description,
            rows_per_chunk,
            chunks_per_shard,
            codec=column.codec,
            level=images.PIXELS_LEVEL if column.is_image else images.ZSTD_LEVEL,
        )

    @cached_property
    def column(self) -> Column:
        """Specification of the column."""
        return Column(
            self.path.name,
            self.data_type,
            self.shape[1:],
            units=self.units,
            dims=self.dims[1:],
            description=self.description,
            codec=self.codec,
        )

    @property
    def is_image(self) -> bool:
        """True if a row is an image, stored as one chunk."""
        return self.column.is_image

    def partial(self, number: int) -> Path:
        """Return the path of the shard while it grows."""
        final = self.shard(number)
        return final.with_name(final.name + PARTIAL)

    def shard_numbers(self) -> list[int]:
        """Return the numbers of all shards, sealed or growing, in order."""
        root = self.path / "c"
        if not root.is_dir():
            return []
        names = {entry.name.removesuffix(PARTIAL) for entry in root.iterdir()}
        numbers = sorted(int(name) for name in names if name.isdecimal())
        # A crash before the first record leaves an empty directory.
        return [n for n in numbers if self.shard(n).exists() or self.partial(n).exists()]

    def rows(self) -> int:
        """Return the declared length of the array now, as every Zarr reader sees it."""
        document = documents.read_document(self.files, self.path / "zarr.json")
        check_shape(document.get("shape"), self.data_type, self.files.name(self.path))
        return int(document["shape"][0])

    def set_rows(self, rows: int) -> None:
        """Set the declared length of the array, atomically."""
        document = documents.read_document(LOCAL, self.path / "zarr.json")
        if document["shape"][0] != rows:
            document["shape"][0] = rows
            documents.write_json(self.path / "zarr.json", document)


@dataclass(frozen=True, slots=True)
class StreamLayout:
    """One stream on disk: its columns, grouped by the way they are written."""

    path: Path
    """Directory of the group."""
    small: tuple[ColumnLayout, ...]
    """Columns whose rows are journalled together, the time column last."""
    image: ColumnLayout | None
    """Column of images, if there is one."""

    @property
    def name(self) -> str:
        """Name of the stream."""
        return self.path.name

    @property
    def columns(self) -> tuple[ColumnLayout, ...]:
        """All columns, the image first."""
        return ((self.image,) if self.image else ()) + self.small

    @property
    def time(self) -> ColumnLayout:
        """The time column."""
        return self.small[-1]

    @property
    def block(self) -> int:
        """Rows per chunk of the small columns, and per journal."""
        return self.time.rows_per_chunk

    @property
    def row_dtype(self) -> np.dtype[np.void]:
        """Packed numpy type of one journal row."""
        return np.dtype([(c.column.name, c.dtype, c.column.shape) for c in self.small])

    def journal(self, first_row: int) -> Path:
        """Return the path of the journal that starts at a row.

        It is in the time column's directory, where Zarr readers do not list it.
        """
        return self.time.path / f"journal-{first_row}"

    def journals(self) -> dict[int, Path]:
        """Return the journals by the row at which they start."""
        paths = self.time.path.glob("journal-*")
        numbers = {path.name.removeprefix("journal-"): path for path in paths}
        return {int(number): path for number, path in numbers.items() if number.isdecimal()}

    @property
    def reserved(self) -> Path:
        """File that reserves space while the stream is being written."""
        return self.time.path / RESERVED

    def is_unfinished(self, path: Path) -> bool:
        """Return True if a path below the stream exists only while the stream is being written."""
        name, parent = path.name, path.parent
        if path == self.reserved or (parent == self.time.path and name.startswith("journal-")):
            return True
        columns = [column.path for column in self.columns]
        if name.endswith(TEMPORARY) and parent in (self.path, *columns):
            return True
        return PARTIAL in name and any(column / "c" in path.parents for column in columns)

    def attrs(self) -> dict[str, Any]:
        """Return the attributes of the group."""
        document = documents.read_document(self.time.files, self.path / "zarr.json")
        attributes: dict[str, Any] = document.get("attributes", {})
        return attributes

    def set_attrs(self, **attrs: Any) -> None:
        """Merge into the attributes of the group, atomically."""
        documents.merge_attrs(self.path, attrs)

    @classmethod
    def load(cls, path: Path, files: Files = LOCAL) -> Self:
        """Return the layout of a stream on disk."""
        attrs = documents.read_document(files, path / "zarr.json").get("attributes", {})
        names = attrs.get("columns")
        if not isinstance(names, list) or not names:
            raise SessionError(f"{path}: found no attrs columns, expected a stream")
        if len(set(map(str, names))) < len(names):
            raise SessionError(f"{path}: found columns {names!r:.200}, expected each once")
        for name in map(str, names):
            if Path(name).name != name or name == "..":  # must not lead out of the stream
                raise SessionError(f"{path}: found column {name!r}, expected a plain name")
        documents.check_rate(attrs.get("rate_hz"), files.name(path))
        documents.check_stream_attrs(attrs, files.name(path))
        columns = [ColumnLayout.load(path / str(name), files) for name in names]
        small = tuple(column for column in columns if not column.is_image)
        images_ = [column for column in columns if column.is_image]
        if not small or len({column.rows_per_chunk for column in small}) != 1:
            raise SessionError(f"{path}: the columns {names} are not chunked alike")
        return cls(path, small, images_[0] if images_ else None)


def create_stream(path: Path, spec: StreamSpec) -> StreamLayout:
    """Create the group and the empty arrays of a stream; the caller flushes them to the disk."""
    path.mkdir()
    attrs = {"rate_hz": spec.rate_hz, "columns": [column.name for column in spec.columns]}
    documents.write_group(path, {**spec.attrs, **spec.traits.to_json(), **attrs}, durable=False)
    jpegs = spec.has_jpegs
    for column in spec.columns:
        rows, chunks = spec.block, BLOCKS_PER_JPEG_SHARD if jpegs else CHUNKS_PER_SHARD
        if column.is_image:
            rows, chunks = 1, JPEGS_PER_SHARD if jpegs else CHUNKS_PER_SHARD
        ColumnLayout.of(path / column.name, column, rows, chunks).create(durable=False)
    return StreamLayout.load(path)


# Tables: groups of columns that are written in one go, `targets` and `frames`.

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
    """Write a group with an array (n, ...) per column, their `units` and its `attrs`.

    The caller flushes them to the disk.
    """
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise SessionError(f"{path}: columns of unequal length: {lengths}")
    path.mkdir()
    documents.write_group(path, {**(attrs or {}), "columns": list(columns)}, durable=False)
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


def table_columns(path: Path, files: Files = LOCAL) -> tuple[str, ...]:
    """Return the names of the columns of a table, sorted; none if there is no table."""
    names = tuple(sorted(entry.name for entry in files.groups(path)))
    if names:
        documents.read_document(files, path / "zarr.json")
    return names
