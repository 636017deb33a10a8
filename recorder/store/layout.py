"""Layout of a stream's arrays on disk, and the Zarr v3 metadata that describes them.

Every column is one array with uniform chunking: `rows_per_chunk` rows per inner chunk,
`chunks_per_shard` inner chunks per shard, one file `c/<shard>/0/...` per shard.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.errors import SessionError
from recorder.spec import FORMAT, FORMAT_VERSION, RATE_MAX_HZ, STATUSES, Column, StreamSpec
from recorder.store import images
from recorder.store.bounds import check_session_attrs, check_stream_attrs
from recorder.store.documents import read_document
from recorder.store.durable import read_json, write_json
from recorder.store.files import LOCAL, Files

# Inner chunks per shard of new columns. Sealing costs the same for every shard; the shards of JPEG
# images would be small and many otherwise.
CHUNKS_PER_SHARD = 64
JPEGS_PER_SHARD = 512
# Chunks per shard of the other columns of a stream of JPEG images, whose blocks are larger.
BLOCKS_PER_JPEG_SHARD = 16
# Largest number of inner chunks per shard that is read.
CHUNKS_MAX = 1 << 16
# Largest metadata accepted, so that a corrupt or hostile file cannot make a reader allocate memory.
ROWS_MAX = 1 << 40
SIDE_MAX = 1 << 16
ROW_BYTES_MAX = 1 << 28
CHUNK_BYTES_MAX = 1 << 30
# Attribute of a closed session whose derived files are being built again: its status before.
REBUILDING = "rebuilding"
# Suffix of a shard that is still growing; Zarr readers ignore it.
PARTIAL = ".partial"


@dataclass(frozen=True, slots=True)
class Layout:
    """One column on disk."""

    path: Path
    """Directory of the array."""
    column: Column
    """Specification of the column."""
    rows_per_chunk: int
    """Rows per inner chunk; 1 for images."""
    files: Files = field(default=LOCAL, repr=False, compare=False)
    """File access for the directory."""
    chunks_per_shard: int = 0
    """Inner chunks per full shard; 0 for the number of a new column."""
    dtype: np.dtype[Any] = field(init=False)
    """Little-endian numpy type of the column."""

    def __post_init__(self) -> None:
        """Derive the numpy type and the number of chunks."""
        if not self.chunks_per_shard:
            new = JPEGS_PER_SHARD if self.column.codec == "jpeg" else CHUNKS_PER_SHARD
            object.__setattr__(self, "chunks_per_shard", new)
        object.__setattr__(self, "dtype", np.dtype(self.column.dtype).newbyteorder("<"))

    @property
    def rows_per_shard(self) -> int:
        """Rows per full shard."""
        return self.rows_per_chunk * self.chunks_per_shard

    @property
    def chunk_shape(self) -> tuple[int, ...]:
        """Shape of an inner chunk."""
        return (self.rows_per_chunk, *self.column.shape)

    @property
    def chunk_bytes(self) -> int:
        """Size of a decoded inner chunk [bytes]."""
        return self.rows_per_chunk * self.column.row_bytes

    def shard(self, number: int) -> Path:
        """Return the path of a sealed shard."""
        return self.path.joinpath("c", str(number), *("0" for _ in self.column.shape))

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
        """Return the declared length of the array, as every Zarr reader sees it."""
        document = read_document(self.files, self.path / "zarr.json")
        check_shape(document.get("shape"), self.column.dtype, self.files.name(self.path))
        return int(document["shape"][0])

    def set_rows(self, rows: int) -> None:
        """Set the declared length of the array, atomically."""
        document = read_json(self.path / "zarr.json")
        if document["shape"][0] != rows:
            document["shape"][0] = rows
            write_json(self.path / "zarr.json", document)

    def create(self) -> None:
        """Write the metadata of an empty array."""
        self.path.mkdir()
        write_json(self.path / "zarr.json", self._document())

    def _document(self) -> dict[str, Any]:
        column = self.column
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": [0, *column.shape],
            "data_type": column.dtype,
            "chunk_grid": {
                "name": "regular",
                "configuration": {"chunk_shape": [self.rows_per_shard, *column.shape]},
            },
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            # Use NaN as the fill value if the type allows it, so that missing data is recognisable.
            "fill_value": "NaN" if column.dtype.startswith("float") else 0,
            "codecs": [
                {
                    "name": "sharding_indexed",
                    "configuration": {
                        "chunk_shape": list(self.chunk_shape),
                        "codecs": _inner_codecs(column),
                        "index_codecs": [
                            {"name": "bytes", "configuration": {"endian": "little"}},
                            {"name": "crc32c"},
                        ],
                        "index_location": "end",
                    },
                }
            ],
            "attributes": {"units": column.units, "description": column.description},
            "dimension_names": ["row", *(column.dims or _numbered(column.shape))],
            "storage_transformers": [],
        }

    @classmethod
    def load(cls, path: Path, files: Files = LOCAL) -> Self:
        """Return the layout described by an array's metadata."""
        document = read_document(files, path / "zarr.json")
        try:
            check_shape(document["shape"], document["data_type"], files.name(path))
            (sharding,) = (codec["configuration"] for codec in document["codecs"])
            inner = sharding["codecs"][0]["name"]
            attributes = document["attributes"]
            column = Column(
                path.name,
                document["data_type"],
                tuple(document["shape"][1:]),
                units=attributes.get("units", ""),
                dims=tuple(document["dimension_names"][1:]),
                description=attributes.get("description", ""),
                codec="jpeg" if inner == "imagecodecs_jpeg" else "zstd",
            )
            per_chunk = sharding["chunk_shape"][0]
            if (
                type(per_chunk) is not int
                or not 0 < per_chunk * column.row_bytes <= CHUNK_BYTES_MAX
            ):
                raise SessionError(
                    f"{files.name(path)}: found chunk_shape {sharding['chunk_shape']}; allowed: "
                    f"up to {CHUNK_BYTES_MAX} bytes"
                )
            per_shard = document["chunk_grid"]["configuration"]["chunk_shape"][0]
            if type(per_shard) is not int or not per_chunk <= per_shard <= CHUNKS_MAX * per_chunk:
                raise SessionError(
                    f"{files.name(path)}: found {per_shard!r:.80} rows per shard; allowed: "
                    f"{per_chunk} to {CHUNKS_MAX * per_chunk}"
                )
            layout = cls(path, column, per_chunk, files, per_shard // per_chunk)
            expected = layout._document()
            found = {key: document[key] for key in ("node_type", "chunk_grid", "codecs")}
            for one in (found, expected):
                one["codecs"] = _without_level(one["codecs"])
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise SessionError(f"{path}: not an array of a stream: {error!r}") from error
        for key, value in found.items():
            if value != expected[key]:
                raise SessionError(f"{path}: found {key} {value}, expected {expected[key]}")
        return layout


def check_shape(shape: object, dtype: str, where: str) -> None:
    """Reject the shape of an array that no session has, before anything is allocated for it."""
    if (
        not isinstance(shape, list)
        or not shape
        or not all(type(length) is int for length in shape)
        or not 0 <= shape[0] <= ROWS_MAX
        or not all(0 < length <= SIDE_MAX for length in shape[1:])
        or math.prod(shape[1:]) * np.dtype(dtype).itemsize > ROW_BYTES_MAX
    ):
        raise SessionError(
            f"{where}: found shape {shape!r:.200}; allowed: up to {ROWS_MAX} rows, each with sides "
            f"up to {SIDE_MAX} and {ROW_BYTES_MAX} bytes"
        )


def check_rate(rate_hz: object, where: str) -> None:
    """Reject a rate that no device has."""
    number = isinstance(rate_hz, int | float) and not isinstance(rate_hz, bool)
    if not number or not 0 < rate_hz <= RATE_MAX_HZ:  # type: ignore[operator]
        raise SessionError(
            f"{where}: found rate_hz {rate_hz!r:.80}; allowed: above 0 to {RATE_MAX_HZ:g}"
        )


@dataclass(frozen=True, slots=True)
class StreamLayout:
    """One stream on disk: its columns, grouped by the way they are written."""

    path: Path
    """Directory of the group."""
    small: tuple[Layout, ...]
    """Columns whose rows are journalled together, the time column last."""
    image: Layout | None
    """Column of images, if there is one."""

    @property
    def name(self) -> str:
        """Name of the stream."""
        return self.path.name

    @property
    def columns(self) -> tuple[Layout, ...]:
        """All columns, the image first."""
        return ((self.image,) if self.image else ()) + self.small

    @property
    def time(self) -> Layout:
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

    def attrs(self) -> dict[str, Any]:
        """Return the attributes of the group."""
        document = read_document(self.time.files, self.path / "zarr.json")
        attributes: dict[str, Any] = document.get("attributes", {})
        return attributes

    def set_attrs(self, **attrs: Any) -> None:
        """Merge into the attributes of the group, atomically."""
        merge_attrs(self.path, attrs)

    @classmethod
    def load(cls, path: Path, files: Files = LOCAL) -> Self:
        """Return the layout of a stream on disk."""
        attrs = read_document(files, path / "zarr.json").get("attributes", {})
        names = attrs.get("columns") if isinstance(attrs, dict) else None
        if not isinstance(names, list) or not names:
            raise SessionError(f"{path}: found no attrs columns, expected a stream")
        for name in map(str, names):
            if Path(name).name != name or name == "..":  # must not lead out of the stream
                raise SessionError(f"{path}: found column {name!r}, expected a plain name")
        check_rate(attrs.get("rate_hz"), files.name(path))
        check_stream_attrs(attrs, files.name(path))
        columns = [Layout.load(path / str(name), files) for name in names]
        small = tuple(column for column in columns if not column.column.is_image)
        images_ = [column for column in columns if column.column.is_image]
        if not small or len({column.rows_per_chunk for column in small}) != 1:
            raise SessionError(f"{path}: the columns {names} are not chunked alike")
        return cls(path, small, images_[0] if images_ else None)


def create_stream(path: Path, spec: StreamSpec) -> StreamLayout:
    """Create the group and the empty arrays of a stream."""
    path.mkdir()
    attrs = {"rate_hz": spec.rate_hz, "columns": [column.name for column in spec.columns]}
    write_group(path, {**spec.attrs, **spec.traits.to_json(), **attrs})
    blocks = BLOCKS_PER_JPEG_SHARD if spec.has_jpegs else 0
    for column in spec.columns:
        rows, chunks = (1, 0) if column.is_image else (spec.block, blocks)
        Layout(path / column.name, column, rows, chunks_per_shard=chunks).create()
    return StreamLayout.load(path)


def read_order(path: Path, files: Files = LOCAL) -> list[str]:
    """Return the names of the streams in the order in which the session declared them."""
    order = read_document(files, path / "zarr.json").get("attributes", {}).get("order")
    if not isinstance(order, list) or not all(isinstance(name, str) for name in order):
        raise SessionError(f"{files.name(path)}: found order {order!r:.80}, expected names")
    return order


def write_group(path: Path, attrs: dict[str, Any]) -> None:
    """Write the metadata of a Zarr group."""
    write_json(path / "zarr.json", {"zarr_format": 3, "node_type": "group", "attributes": attrs})


def merge_attrs(path: Path, attrs: dict[str, Any]) -> None:
    """Merge into the attributes of a group, atomically."""
    document = read_json(path / "zarr.json")
    before = document.get("attributes", {})
    document["attributes"] = {**before, **attrs}
    if document["attributes"] != before:
        write_json(path / "zarr.json", document)


def _without_level(codecs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the metadata of a sharding codec without levels, which matter to writers only."""
    (outer,) = codecs
    sharding = outer["configuration"]
    inner = [
        {**codec, "configuration": {**codec.get("configuration", {}), "level": None}}
        for codec in sharding["codecs"]
    ]
    return [{**outer, "configuration": {**sharding, "codecs": inner}}]


def _inner_codecs(column: Column) -> list[dict[str, Any]]:
    jpeg = [{"name": "imagecodecs_jpeg", "configuration": {"level": images.JPEG_QUALITY}}]
    level = images.PIXELS_LEVEL if column.is_image else images.ZSTD_LEVEL
    zstd = [
        {"name": "bytes", "configuration": {"endian": "little"}},
        {"name": "zstd", "configuration": {"level": level, "checksum": False}},
    ]
    return [*(jpeg if column.codec == "jpeg" else zstd), {"name": "crc32c"}]


def _numbered(shape: tuple[int, ...]) -> list[str]:
    return [f"dim_{axis}" for axis in range(1, len(shape) + 1)]


def decoded_rows(layout: Layout, data: bytes) -> np.ndarray[Any, Any]:
    """Return the rows of one chunk of a small column, fill values included."""
    try:
        plain = images.decompress(data, layout.chunk_bytes)
    except SessionError as error:
        raise SessionError(f"{layout.path}: {error}") from error
    return np.frombuffer(plain, layout.dtype).reshape(layout.chunk_shape)


# Attributes of a session or an archive.


class _Attributes(dict[str, Any]):
    """Attributes of a session or an archive; `attrs["x"]` raises `SessionError` without an x."""

    where = ""

    def __missing__(self, key: str) -> Any:
        raise SessionError(f"{self.where}: attribute {key!r} is missing")


def read_session_attrs(path: Path, files: Files = LOCAL) -> dict[str, Any]:
    """Return the attributes of a session."""
    attrs = read_attrs(path, files, what="session", format_=FORMAT, version=FORMAT_VERSION)
    name = files.name(path)
    for key, allowed in (("status", STATUSES), (REBUILDING, STATUSES[1:])):
        found = attrs["status"] if key == "status" else attrs.get(key, allowed[0])
        if found not in allowed:
            known = ", ".join(allowed)
            raise SessionError(f"{name}: found {key} {found!r:.80}; allowed: {known}")
    if "rate_hz" in attrs:
        check_rate(attrs["rate_hz"], name)
    _check_runs(attrs["runs"], name)
    check_session_attrs(attrs, name)
    return attrs


def _check_runs(runs: object, name: str) -> None:
    if not isinstance(runs, list):
        raise SessionError(f"{name}: found runs {runs!r:.80}, expected a list")
    before: dict[str, int] = {}
    for number, run in enumerate(runs):
        first_row = run.get("first_row") if isinstance(run, dict) else None
        if not isinstance(first_row, dict):
            raise SessionError(f"{name}: found runs[{number}] {run!r:.80}, expected its first_row")
        for stream, row in first_row.items():
            least = before.get(stream, 0)
            if type(row) is not int or not least <= row <= ROWS_MAX:
                raise SessionError(
                    f"{name}: found runs[{number}] first_row {stream} {row!r:.80}; allowed: "
                    f"{least} to {ROWS_MAX}"
                )
            before[stream] = row


def read_attrs(
    path: Path, files: Files, *, what: str, format_: str, version: int
) -> dict[str, Any]:
    """Return the attributes of a session or an archive.

    Args:
        path: Its directory.
        files: File access for the directory.
        what: Kind of object, for messages.
        format_: Expected value of `format`.
        version: The `format_version` that can be read.
    """
    name = files.name(path)
    if files.local and path.is_file():
        raise SessionError(f"{name}: found a file; allowed: the folder of a session or an archive")
    if files.local and not path.is_dir():
        raise SessionError(f"{name}: no such {what}")
    try:
        files.read(path / "zarr.json")
    except FileNotFoundError as error:
        if not files.local:  # the store's error shows if the bucket itself is missing
            raise SessionError(f"{name}: no such {what} ({error})") from None
    except OSError as error:
        raise SessionError(f"{name}: {error}") from error
    attrs = _Attributes(read_document(files, path / "zarr.json").get("attributes", {}))
    attrs.where = name
    if attrs.get("format") != format_:
        raise SessionError(f"{name}: found format {attrs.get('format')!r}, expected {format_!r}")
    found = attrs.get("format_version")
    if found != version or type(found) is not int:
        newer = type(found) is int and found > version
        raise SessionError(
            f"{name}: found format_version {found}, this program reads {version}"
            + "; update it" * newer
        )
    return attrs


def says_it_is(path: Path, files: Files, format_: str) -> bool:
    """Return True if a place is readable and its metadata declares the given format."""
    try:
        attrs = read_document(files, path / "zarr.json").get("attributes", {})
    except SessionError:
        return False
    return isinstance(attrs, dict) and attrs.get("format") == format_
