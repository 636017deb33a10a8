"""Copy a session, storing its images in another encoding. The source is never changed.

`portable` stores images as zstd-compressed pixels, which every Zarr v3 reader understands;
`camera` keeps the camera's JPEG bytes and is possible only if the session has them.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from recorder.errors import SessionError
from recorder.session.reader import Session
from recorder.store import images
from recorder.store.column import ColumnReader
from recorder.store.durable import sync_directory
from recorder.store.files import LOCAL, is_url
from recorder.store.layout import Layout, StreamLayout
from recorder.store.manifest import GROUP, seal
from recorder.store.shard import ColumnLog

PROFILES = ("portable", "camera")

_CREATING = ".creating"

# Called with the number of images done and the total.
Progress = Callable[[int, int], None]


def repack(
    source: str | os.PathLike[str],
    destination: str | os.PathLike[str],
    profile: str = "portable",
    *,
    progress: Progress | None = None,
) -> None:
    """Write a copy of a session with its images in another profile.

    All other data is copied, each chunk verified. The copy is sealed by a manifest of its own.
    The destination is created atomically.

    Args:
        source: A finished session.
        destination: Directory to create; must not exist.
        profile: `portable` or `camera`.
        progress: Called after every image that had to be converted.

    Raises:
        SessionError: An unknown profile, an unfinished or corrupt source, an existing destination,
            or `camera` for images that were stored without their JPEG bytes.
    """
    if is_url(source):
        raise SessionError(f"{source}: remote stores are only read; copy it here first")
    if profile not in PROFILES:
        raise SessionError(f"found profile {profile!r}; known: {', '.join(PROFILES)}")
    session, final = Session(source), Path(destination)
    if session.warning:
        raise SessionError(session.warning)
    if final.exists():
        raise SessionError(f"{final}: exists already")
    pictures = [s.layout.image for s in session.streams.values() if s.layout.image is not None]
    convert = [layout for layout in pictures if layout.column.codec == "jpeg"]
    if profile == "camera":
        lost = [str(layout.path) for layout in pictures if layout not in convert]
        if lost:
            raise SessionError(
                f"{lost[0]}: stored without the camera's JPEG bytes, and encoding pixels again "
                "would change them"
            )
        convert = []
    building = final.with_name(final.name + _CREATING)
    shutil.rmtree(building, ignore_errors=True)
    try:
        columns = [layout for layout in _columns(session) if layout not in convert]
        skip = {str(layout.path): "c" for layout in convert}
        skip[str(session.path)] = GROUP
        shutil.copytree(session.path, building, ignore=lambda path, _: [skip.get(path, "")])
        for layout in columns:
            copy = replace(layout, path=building / layout.path.relative_to(session.path))
            _verify(ColumnReader(replace(copy, files=LOCAL)))
        total = sum(layout.rows() for layout in convert)
        done = 0
        for layout in convert:
            copy = replace(layout, path=building / layout.path.relative_to(session.path))
            for count in _decode_all(layout, copy):
                if progress is not None:
                    progress(done + count, total)
            done += layout.rows()
        seal(building, profile=profile)
        building.rename(final)
        sync_directory(final.parent)
    except BaseException:
        shutil.rmtree(building, ignore_errors=True)
        raise


def _columns(session: Session) -> list[Layout]:
    places = [session.path / name for name in ("segments", "reference")]
    tables = [StreamLayout.load(place, session.files) for place in places]
    layouts = [*(stream.layout for stream in session.streams.values()), *tables]
    return [column for layout in layouts for column in layout.columns]


def _verify(reader: ColumnReader) -> None:
    for _ in reader.chunks(_all_chunks(reader)):
        pass


def _all_chunks(reader: ColumnReader) -> range:
    return range(-(-reader.rows // reader.layout.rows_per_chunk))


def _decode_all(source: Layout, copy: Layout) -> Iterator[int]:
    """Write the images of one column as lossless pixels; yield the number done."""
    column = replace(copy.column, codec="zstd")
    pixels = replace(copy, column=column, files=LOCAL)
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
