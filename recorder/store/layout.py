"""Layout of a stream on disk: an array per column, and the journal of the rows that are not in it.

Every column has uniform chunking: `rows_per_chunk` rows per inner chunk, `chunks_per_shard` inner
chunks per shard, one file `c/<shard>/0/...` per shard.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.errors import SessionError
from recorder.spec import Column, StreamSpec
from recorder.store import images
from recorder.store.array import ArrayLayout, check_shape
from recorder.store.documents import (
    check_rate,
    check_stream_attrs,
    merge_attrs,
    read_document,
    write_group,
    write_json,
)
from recorder.store.files import LOCAL, Files

# Chunks per shard of new columns. Sealing costs the same for every shard; the shards of JPEG
# images would be small and many otherwise.
CHUNKS_PER_SHARD = 64
JPEGS_PER_SHARD = 512
# Chunks per shard of the other columns of a stream of JPEG images, whose blocks are larger.
BLOCKS_PER_JPEG_SHARD = 16
# Suffix of a shard that is still growing; Zarr readers ignore it.
PARTIAL = ".partial"


class Layout(ArrayLayout):
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
        document = read_document(self.files, self.path / "zarr.json")
        check_shape(document.get("shape"), self.data_type, self.files.name(self.path))
        return int(document["shape"][0])

    def set_rows(self, rows: int) -> None:
        """Set the declared length of the array, atomically."""
        document = read_document(LOCAL, self.path / "zarr.json")
        if document["shape"][0] != rows:
            document["shape"][0] = rows
            write_json(self.path / "zarr.json", document)


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
        names = attrs.get("columns")
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
    jpegs = spec.has_jpegs
    for column in spec.columns:
        rows, chunks = spec.block, BLOCKS_PER_JPEG_SHARD if jpegs else CHUNKS_PER_SHARD
        if column.is_image:
            rows, chunks = 1, JPEGS_PER_SHARD if jpegs else CHUNKS_PER_SHARD
        Layout.of(path / column.name, column, rows, chunks).create()
    return StreamLayout.load(path)
