"""HDF5: the whole session, under the same names as in Zarr.

Groups, arrays and attributes are those of docs/reference/data-format.md. Attributes that are lists
or objects are stored as JSON text. JPEG images are variable-length rows with the camera's unchanged
bytes.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from recorder.convert.export import Options
from recorder.progress import ReportItems
from recorder.session.columns import Stream
from recorder.session.frames import frame_units
from recorder.session.reader import Session
from recorder.spec import PHASES, TARGET_UNITS, Column

_BLOCK = 4096  # rows
_IMAGES = 16
_RESERVED = 32 << 20  # bytes; more than the chunk caches of all open datasets, 1 MB each
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}


def write(session: Session, path: Path, options: Options, progress: ReportItems) -> None:
    """Write a session as one HDF5 file."""
    with _room_to_close(path) as give_up_room:
        # Attributes above 64 kB, such as a long plan, need the format of HDF5 1.8.
        file = h5py.File(path, "w", libver=("v108", "v108"))
        try:
            _fill(file, session, options, progress)
            file.flush()
        except BaseException:
            give_up_room()
            raise
        finally:
            file.close()


@contextmanager
def _room_to_close(path: Path) -> Iterator[Callable[[], None]]:
    """Reserve the disk space that closing needs; the yielded function releases it.

    If a file cannot be flushed when it is closed, the HDF5 library crashes the interpreter.
    """
    reserved_space = path.with_name(path.name + ".reserved")
    try:
        with reserved_space.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, _RESERVED)
        yield lambda: reserved_space.unlink(missing_ok=True)
    finally:
        reserved_space.unlink(missing_ok=True)


def _fill(file: Any, session: Session, options: Options, progress: ReportItems) -> None:
    streams = {f"streams/{name}": stream for name, stream in session.streams.items()}
    tables = {
        name: Stream(session.path / name, session.files) for name in ("segments", "reference")
    }
    total = max(sum(len(stream) for stream in streams.values()), 1)
    done = 0
    _set_attrs(file, session.attrs)
    for name, stream in {**streams, **tables}.items():
        group = file.create_group(name)
        _set_attrs(group, stream.attrs)
        for layout in stream.layout.columns:
            if layout.is_image:
                for row in _write_images(group, stream, layout.column, options):
                    progress(done + row, total)
            else:
                _write_column(group, stream, layout.column)
        if name in streams:
            done += len(stream)
            progress(done, total)
    _write_table(file.create_group("targets"), session.targets, TARGET_UNITS)
    frames = file.create_group("frames")
    if len(session.frames):
        about = {"rate_hz": session.rate_hz, "phases": list(PHASES), "streams": session.columns}
        _set_attrs(frames, about)
    _write_table(frames, session.frames, frame_units(session))


def _write_column(group: Any, stream: Stream, column: Column) -> None:
    shape = (len(stream), *column.shape)
    out = group.create_dataset(
        column.name, shape, column.dtype, **_chunked(_BLOCK, column.shape), **_PACKED
    )
    _describe(out, column.units, column.description, column.dims)
    for start in range(0, len(stream), _BLOCK):
        stop = min(start + _BLOCK, len(stream))
        out[start:stop] = stream.rows_between(column.name, start, stop)


def _write_images(group: Any, stream: Stream, column: Column, options: Options) -> Iterator[int]:
    """Write the images of a stream; yield the number done."""
    count = len(stream)
    as_bytes = column.codec == "jpeg" and options.images == "stored"
    if as_bytes:
        kind = h5py.vlen_dtype(np.uint8)
        out = group.create_dataset(column.name, (count,), kind, **_chunked(64, ()))
        out.attrs["codec"] = "jpeg"
        out.attrs["image_shape"] = column.shape
    else:
        out = group.create_dataset(
            column.name,
            (count, *column.shape),
            column.dtype,
            **_chunked(1, column.shape),
            **_PACKED,
        )
    _describe(out, column.units, column.description, () if as_bytes else column.dims)
    for start in range(0, count, _IMAGES):
        rows = range(start, min(start + _IMAGES, count))
        if as_bytes:
            for row, data in zip(rows, stream.jpegs(rows), strict=True):
                out[row] = np.frombuffer(data, np.uint8)
        else:
            out[rows.start : rows.stop] = stream.images(rows)
        yield rows.stop


def _write_table(
    group: Any, table: Mapping[str, Any], units: Mapping[str, tuple[str, str]]
) -> None:
    for column, values in table.items():
        layout = _chunked(_BLOCK, values.shape[1:])
        out = group.create_dataset(column, data=values, **layout, **_PACKED)
        _describe(out, *units.get(column, ("1", "")), ())


def _chunked(rows: int, shape: tuple[int, ...]) -> dict[str, Any]:
    # Only resizable arrays may have chunks larger than themselves.
    return {"chunks": (rows, *shape), "maxshape": (None, *shape)}


def _describe(out: Any, units: str, description: str, dims: tuple[str, ...]) -> None:
    out.attrs["units"] = units
    out.attrs["description"] = description
    for axis, label in enumerate(("row", *dims)):
        out.dims[axis].label = label


def _set_attrs(node: Any, attrs: Mapping[str, Any]) -> None:
    for name, value in attrs.items():
        plain = isinstance(value, str | bool | int | float) and "\0" not in str(value)
        node.attrs[name] = value if plain else json.dumps(value)
