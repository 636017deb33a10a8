"""The row journal: one record per row, until a block of rows is stored as chunks.

One chunk per sample would be slow for every plain reader; a sample kept in memory until its chunk
is full would be lost in a crash. Each row is therefore first appended here, with all small columns
of the stream in one record, and a full block later becomes one chunk per column.
"""

import errno
import os
from dataclasses import dataclass
from pathlib import Path

import google_crc32c

from recorder.store.files import TEMPORARY, replace_file, sync_directory
from recorder.store.layout import StreamLayout
from recorder.store.records import CHUNK_MAGIC, CRC_BYTES, HEADER, header, record_matches

# A log of images grows ahead of them in steps of this size [bytes], which read as zeros: the blocks
# of many images are allocated at once. Records below a page gain nothing.
STEP = 1 << 21
_AHEAD_FROM = 1 << 12


@dataclass(frozen=True, slots=True)
class JournalRecord:
    """Position of one complete record in a log."""

    offset: int
    """First byte of the payload in the file."""
    nbytes: int
    """Length of the payload."""
    crc: int
    """CRC-32C of the payload, without the one at its own end."""

    @property
    def end(self) -> int:
        """First byte after the record."""
        return self.offset + self.nbytes


class GrowingLog:
    """The complete records of a log so far; each byte is read once, nothing is locked or kept open.

    They end at the first record that is torn, corrupt or out of order.
    """

    def __init__(
        self, path: Path, *, first_index: int, limit: int, payloads: bool = False, sums: bool = True
    ) -> None:
        """Read nothing yet of a log of at most `limit` records, the first of which has a number.

        `payloads` keeps the payloads. Without `sums` the bytes of a chunk are left to its reader:
        only the header and the checksum at the end of a record are verified.
        """
        self.path = path
        self.records: list[JournalRecord] = []
        self.payloads: list[bytes] = []
        self._first, self._limit, self._keeps, self._sums = first_index, limit, payloads, sums
        self._inode = -1
        self._last_head = b""

    @property
    def end(self) -> int:
        """First byte after the last record."""
        return self.records[-1].end if self.records else 0

    def update(self) -> None:
        """Read the records that were added."""
        fd = os.open(self.path, os.O_RDONLY)
        try:
            stat = os.fstat(fd)
            if stat.st_ino != self._inode or not self._continues(fd):
                self.records.clear()
                self.payloads.clear()
                self._inode = stat.st_ino
            while len(self.records) < self._limit and self._read_record(fd, stat.st_size):
                pass
        finally:
            os.close(fd)

    def tail(self, start: int) -> bytes:
        """Return the bytes of the file from `start` on, without zeros at the end."""
        with self.path.open("rb") as file:
            file.seek(start)
            return file.read().rstrip(b"\0")

    def _continues(self, fd: int) -> bool:
        """Return False if the last record was removed, as on a full disk."""
        if not self.records:
            return True
        return os.pread(fd, HEADER.size, self.records[-1].offset - HEADER.size) == self._last_head

    def _read_record(self, fd: int, size: int) -> bool:
        start = self.end + HEADER.size
        if start > size:
            return False
        head = os.pread(fd, HEADER.size, start - HEADER.size)
        magic, nbytes, crc, _, index = HEADER.unpack(head)
        if start + nbytes > size:  # torn, or no record; nothing is allocated for it
            return False
        number = self._first + len(self.records)
        if magic == CHUNK_MAGIC and not self._sums:
            payload = os.pread(fd, CRC_BYTES, start + max(nbytes - CRC_BYTES, 0))
            whole = index == number & 0xFFFFFFFF and crc == google_crc32c.value(head[12:] + payload)
        else:
            payload = os.pread(fd, nbytes, start)
            whole = record_matches(head, payload, number)
        if not whole:
            return False
        if magic == CHUNK_MAGIC:
            crc = int.from_bytes(payload[-CRC_BYTES:], "little")
        self.records.append(JournalRecord(start, nbytes, crc))
        if self._keeps:
            self.payloads.append(payload)
        self._last_head = head
        return True


class RecordLog:
    """File to which only complete records are appended; zeros may follow the last one.

    `append` is called by one thread; `sync` may be called by another.
    """

    def __init__(
        self, path: Path, *, end: int = 0, below: Path | None = None, step: int = 0
    ) -> None:
        """Open a log, or create it, and drop everything after byte `end`, of its last record.

        Directories below `below` may be as new as the file, and are made durable with it. The file
        grows ahead of its records by `step` [bytes], at most `STEP`; 0 for none.
        """
        self.path = path
        self.end = end
        self._step = step
        self._room = end  # length of the file
        depth = len(path.relative_to(below).parts) if below is not None else 1
        self._directories = [*path.parents][:depth]
        self._fd = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
        os.ftruncate(self._fd, end)
        self._synced = -1  # bytes; a fresh file's name is not durable either

    def append(self, *parts: bytes) -> int:
        """Add one record, of a header and parts of a payload; return the payload's offset."""
        start = self.end
        try:
            if len(parts) == 1:
                nbytes = len(parts[0])
                written = os.pwrite(self._fd, parts[0], start)
            else:
                nbytes = sum(map(len, parts))
                if start + nbytes > self._room:
                    self._grow(nbytes)
                written = os.pwritev(self._fd, parts, start)
            # A full disk shortens a write without an error; only the next write would fail.
            if written < nbytes:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        except OSError:
            self.truncate(start)
            raise
        if start + written > self._room:
            self._room = start + written
        self.end = start + nbytes
        return start + HEADER.size

    def _grow(self, nbytes: int) -> None:
        """Allocate blocks ahead of a record, if there is room for them and it gains by them."""
        if not _AHEAD_FROM <= nbytes < self._step // 8:
            return
        try:
            os.posix_fallocate(self._fd, self._room, self._step)
            self._room += self._step
        except OSError:  # the disk may still have room for the record
            os.ftruncate(self._fd, self._room)

    def finish(self, trailer: bytes) -> None:
        """Append bytes that are not a record as the end of the file, and make the file durable."""
        try:
            if os.pwrite(self._fd, trailer, self.end) != len(trailer):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
            if self._room > self.end + len(trailer):
                os.ftruncate(self._fd, self.end + len(trailer))
            os.fdatasync(self._fd)
        except OSError:
            self.truncate(self.end)
            raise

    def truncate(self, end: int) -> None:
        """Drop everything after byte `end`, which must be the end of a record."""
        os.ftruncate(self._fd, end)
        self.end = self._room = end
        self._synced = min(self._synced, end - 1)

    def clear(self) -> None:
        """Replace all records by zeros; the file keeps its length and may get another name."""
        if os.pwrite(self._fd, bytes(self._room), 0) != self._room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        self.end = 0
        self._synced = -1

    def sync(self) -> None:
        """Make all appended records survive a power failure."""
        end = self.end
        if end == self._synced:
            return
        os.fdatasync(self._fd)
        if self._synced < 0:
            for directory in self._directories:
                sync_directory(directory)
        self._synced = end

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class Journal:
    """The open journal of a stream: the rows from `first_row` on, at most one block."""

    def __init__(self, layout: StreamLayout, first_row: int, rows: list[bytes]) -> None:
        """Open the journal that starts at a row and contains `rows`; drop everything after them."""
        self.first_row = first_row
        self.rows = rows
        self.path = layout.journal(first_row)
        self._block = layout.block
        width = HEADER.size + layout.row_dtype.itemsize
        self._log = RecordLog(self.path, end=width * len(rows))

    @property
    def full(self) -> bool:
        """True if the journal holds a full block."""
        return len(self.rows) == self._block

    def append(self, row: bytes, t_ns: int) -> None:
        """Append one packed row; this commits the row."""
        self._log.append(header(row, t_ns, self.first_row + len(self.rows)) + row)
        self.rows.append(row)

    def sync(self) -> None:
        """Make its rows survive a power failure. May be called from another thread."""
        self._log.sync()

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._log.close()

    def remove(self) -> None:
        """Delete the file, once its rows are durably stored as chunks."""
        self._log.close()
        self.path.unlink(missing_ok=True)

    def retire(self) -> None:
        """Rename the file instead of deleting it, for `restart`. May be called twice.

        Creating a file costs a file system far more than renaming one. To readers and to recovery,
        a file of this name is rubbish.
        """
        if not self.path.name.endswith(TEMPORARY):
            self._rename(self.path.with_name(self.path.name + TEMPORARY))

    def restart(self, first_row: int) -> None:
        """Turn a retired journal into the empty one that starts at a row.

        Its blocks on the disk are kept: zeros take the place of its rows.
        """
        self._log.clear()
        self._rename(self.path.with_name(f"journal-{first_row}"))
        self.first_row, self.rows = first_row, []

    def _rename(self, path: Path) -> None:
        self.path.replace(path)
        self.path = self._log.path = path


class JournalReader:
    """The rows in the journals of a stream, read while its writer appends to them."""

    def __init__(self, layout: StreamLayout) -> None:
        """Read nothing yet."""
        self._layout = layout
        self._logs: dict[Path, GrowingLog] = {}
        self.first_row = 0
        """Row of the stream at which `rows` starts."""
        self.rows: list[bytes] = []
        """Packed, complete rows, up to the first gap."""
        self.torn_bytes = 0
        """Bytes that belong to no row of `rows`, without zeros at the end of a journal."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """All journals, including those whose rows are not consecutive, in order of their rows."""
        return tuple(self._logs)

    def update(self, journals: dict[int, Path], *, torn: bool = False) -> None:
        """Read what was added to the journals of the stream; count torn bytes only if `torn`."""
        ordered = sorted(journals.items())
        self._logs = {
            path: self._logs.get(path)
            or GrowingLog(path, first_index=first, limit=self._layout.block, payloads=True)
            for first, path in ordered
        }
        self.first_row, self.rows, self.torn_bytes = min(journals, default=0), [], 0
        for first, path in ordered:
            log = self._logs[path]
            log.update()
            follows = first == self.first_row + len(self.rows)  # else the one before it is torn
            self.rows += log.payloads if follows else []
            if torn:
                self.torn_bytes += len(log.tail(log.end if follows else 0))


def write_journal(layout: StreamLayout, first_row: int, rows: list[bytes]) -> None:
    """Write a journal in one go, durably."""
    records = []
    for index, row in enumerate(rows, first_row):
        records += [header(row, row_time(row), index), row]
    replace_file(layout.journal(first_row), b"".join(records))


def row_time(row: bytes) -> int:
    """Return the time of a packed row [ns]: its last eight bytes."""
    return int.from_bytes(row[-8:], "little", signed=True)
