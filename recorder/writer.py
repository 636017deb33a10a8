"""Appends rows to one stream. The hot path of every recording process."""

import fcntl
import os
from functools import partial
from pathlib import Path
from typing import Any, Self

from recorder import images
from recorder.background import Background
from recorder.columnlog import ColumnLog
from recorder.errors import SessionError
from recorder.journal import Journal
from recorder.layout import StreamLayout
from recorder.records import HEADER
from recorder.restore import BALLAST, restore, store_block
from recorder.rows import RowPacker
from recorder.shard import OpenShard

_BALLAST_BYTES = 1 << 16  # indices and metadata of a dozen columns, in whole disk blocks


class StreamWriter:
    """The one writer of a stream.

    A row is accepted when `append` returns: from then on it survives the death of this process,
    and within `sync_interval` seconds that of the machine. Images go straight into the open shard,
    the other columns into the row journal, which commits the row; sealing, encoding and flushing
    happen in a thread of their own.
    """

    def __init__(self, layout: StreamLayout, lock: int, sync_interval: float) -> None:
        """Use `open` instead."""
        self._layout = layout
        self._lock = lock
        self._closed = False
        stream = restore(layout)
        self._image = stream.image
        self._small = stream.small
        self._journal = stream.journal
        self._pack = RowPacker(layout).pack
        self._time = layout.time.column.name
        if layout.image is not None:
            image = layout.image.column
            self._image_name = image.name
            self._encode = images.encoder(image, f"{layout.name}.{image.name}")
        self.rows: int = self._journal.first_row + len(self._journal.rows)
        """Rows accepted so far."""
        _write_ballast(layout)
        layout.set_attrs(sync_interval=sync_interval)
        self._background = Background(
            self._sync, interval=sync_interval, name=f"recorder-{layout.name}"
        )

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, sync_interval: float = 1.0) -> Self:
        """Open a stream to write behind its last whole row, whatever its last writer came to.

        Args:
            path: The stream's group, e.g. `<session>/streams/force`.
            sync_interval: Longest time between two flushes to the disk [s].

        Raises:
            SessionError: Not a stream, damaged, or open in another writer.
        """
        layout = StreamLayout.load(Path(path))
        lock = lock_stream(layout)
        try:
            return cls(layout, lock, sync_interval)
        except BaseException:
            os.close(lock)
            raise

    def append(self, **columns: Any) -> int:
        """Append one row and return its number.

        An image is JPEG bytes or pixels, as its column declares; every other column a number or
        array of the declared shape. Integers may go into float columns, NaN only there.

        Raises:
            SessionError: A missing, unknown or ill-typed column, or a closed writer.
            OSError: The disk is full or failing. The row is not stored, the rows before it are.
        """
        if self._closed:
            raise SessionError(f"{self._layout.name}: the writer is closed")
        if self._background.failure is not None:
            failure = self._background.failure
            raise OSError(failure.errno, failure.strerror, failure.filename) from failure
        row = self._pack(columns)
        t_ns = int(columns[self._time])
        if self._image is None:
            self._journal.append(row, t_ns)
        else:
            self._image.append(self._encode(columns[self._image_name]), t_ns)
            try:
                self._journal.append(row, t_ns)
            except OSError:
                self._image.drop_last()
                raise
        number = self.rows
        self.rows += 1
        self._hand_over()
        return number

    def set_attrs(self, **attrs: Any) -> None:
        """Merge into the stream's attributes, atomically.

        Raises:
            SessionError: A value that JSON cannot hold.
        """
        self._layout.set_attrs(**attrs)

    def close(self) -> None:
        """Seal what was appended, so that every Zarr reader sees it. Safe twice.

        Raises:
            OSError: No room even for that; all rows are kept for `recover`.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._background.stop()
            (self._layout.time.path / BALLAST).unlink(missing_ok=True)
            self._background.drain()
            self._seal()
        finally:
            for log in (*self._small, *([self._image] if self._image else [])):
                log.close()
            self._journal.close()
            os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _hand_over(self) -> None:
        """Give what became full to the background thread and start anew.

        Both hand-overs come after the row was committed, so no shard is ever sealed with an image
        that has no row.
        """
        if self._image is not None:
            shard = self._image.take_full()
            if shard is not None:
                self._background.submit(
                    partial(self._seal_images, self._image, shard, self._journal)
                )
        if self._journal.full:
            full = self._journal
            self._journal = Journal(self._layout, self.rows, [])
            self._background.submit(partial(self._store, full))

    def _seal_images(self, log: ColumnLog, shard: OpenShard, journal: Journal) -> None:
        journal.sync()
        log.seal(shard)

    def _store(self, journal: Journal) -> None:
        store_block(self._layout, self._small, journal.first_row, journal.rows)
        self._sync()
        journal.remove()

    def _sync(self) -> None:
        # Images first: after a power cut a row without its image does not count.
        if self._image is not None:
            self._image.sync()
        for log in self._small:
            log.sync()
        self._journal.sync()

    def _seal(self) -> None:
        self._sync()  # until all columns are sealed, the journal is what a recovery relies on
        if self._journal.rows:
            store_block(self._layout, self._small, self._journal.first_row, self._journal.rows)
        for log in (*([self._image] if self._image else []), *self._small):
            log.finish(self.rows)
        self._journal.remove()


def lock_stream(layout: StreamLayout) -> int:
    """Return a file descriptor that holds the stream for this process, until it is closed.

    Raises:
        SessionError: Another writer holds it.
    """
    fd = os.open(layout.time.path, os.O_RDONLY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(fd)
        raise SessionError(f"{layout.path}: is being written by another process") from None
    return fd


def _write_ballast(layout: StreamLayout) -> None:
    """Occupy the room that sealing will need; an already full disk has none to keep."""
    room = _BALLAST_BYTES + layout.block * (layout.row_dtype.itemsize + HEADER.size)
    path = layout.time.path / BALLAST
    try:
        path.write_bytes(bytes(room))
    except OSError:
        path.unlink(missing_ok=True)
