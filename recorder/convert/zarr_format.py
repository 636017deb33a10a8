"""A session copied as it is, or with its images as lossless pixels that every Zarr reader knows."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from recorder.convert.export import Options
from recorder.errors import SessionError
from recorder.progress import ReportItems
from recorder.session.reader import Session
from recorder.store import images
from recorder.store.files import LOCAL
from recorder.store.layout import ColumnLayout, StreamLayout
from recorder.store.manifest import GROUP, seal
from recorder.store.reader import ColumnReader
from recorder.store.shard import ColumnLog


def write(session: Session, path: Path, options: Options, progress: ReportItems) -> None:
    """Copy a session, each chunk verified, and seal the copy by a manifest of its own."""
    if not session.files.local:
        raise SessionError(f"{session.name}: remote stores are only read; copy it here first")
    columns = _columns(session)
    jpegs = [layout for layout in columns if layout.column.codec == "jpeg"]
    decoded = jpegs if options.images == "pixels" else []
    skip = {str(layout.path): "c" for layout in decoded} | {str(session.path): GROUP}
    shutil.copytree(session.path, path, ignore=lambda folder, _: [skip.get(folder, "")])
    total, done = sum(layout.rows() for layout in columns), 0
    for layout in columns:
        own = path / layout.path.relative_to(session.path)
        copy = replace(layout, path=own, files=LOCAL)
        for rows in _decode(layout, copy) if layout in decoded else _verify(copy):
            progress(done + rows, total)
        done += layout.rows()
    profile = "camera" if len(decoded) < len(jpegs) else "portable"
    seal(path, profile=profile)


def _columns(session: Session) -> list[ColumnLayout]:
    groups = [session.path / name for name in ("segments", "reference")]
    tables = [StreamLayout.load(group, session.files) for group in groups]
    layouts = [*(stream.layout for stream in session.streams.values()), *tables]
    return [column for layout in layouts for column in layout.columns]


def _verify(copy: ColumnLayout) -> Iterator[int]:
    """Read every chunk of one column; yield the number of rows done."""
    reader, step = ColumnReader(copy), copy.rows_per_chunk
    chunks = range(-(-reader.rows // step))
    for number, _ in zip(chunks, reader.chunks(chunks), strict=True):
        yield min((number + 1) * step, reader.rows)


def _decode(source: ColumnLayout, copy: ColumnLayout) -> Iterator[int]:
    """Write the images of one column as lossless pixels; yield the number done."""
    level = images.PIXELS_LEVEL
    pixels = replace(copy, shape=(0, *copy.shape[1:]), codec="zstd", level=level)
    shutil.rmtree(pixels.path)
    pixels.create()
    reader, decode = ColumnReader(source), images.decoder(source.column)
    encode = images.encoder(pixels.column, str(pixels.path))
    log = ColumnLog(pixels, 0)
    try:
        for row in range(reader.rows):
            log.append(encode(decode(reader.chunk(row))), 0)
            log.seal_full()
            yield row + 1
        log.finish(reader.rows)
    finally:
        log.close()
