"""Latest value of a record, shared between processes by a memory-mapped file.

One process writes, any number read. A reader never blocks the writer and never sees a partial
record. A plain file in the run's own folder, unlike named shared memory, is removed with the folder
even if processes were killed.
"""

import contextlib
import mmap
import os
from pathlib import Path
from typing import Any, Self

import numpy as np

# The count is raised last. A writer killed while writing leaves the count at the previous record,
# which lies in another slot and is complete, so a dead writer never hangs a reader.
_COUNTER = np.dtype("<u8")
# Bytes before the first slot: a cache line.
_HEADER = 64
# Slots of a record of which only the newest is read.
SLOTS = 8


def _slot(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the dtype of a slot: record number and record, in whole cache lines."""
    size = _COUNTER.itemsize + dtype.itemsize
    return np.dtype(
        {
            "names": ["number", "record"],
            "formats": [_COUNTER, dtype],
            "offsets": [0, _COUNTER.itemsize],
            "itemsize": size + -size % 64,
        }
    )


class SharedLatest:
    """Structured record with one writer.

    Layout: u64 count of records written, then slots of (u64 record number, record). Record k lies
    in slot k % slots. Its number is written after its content: a reader that finds number k before
    and after copying has a complete record k.
    """

    def __init__(self, path: Path, dtype: np.dtype[Any], *, writable: bool) -> None:
        slot = _slot(dtype)
        flags = os.O_RDWR if writable else os.O_RDONLY
        fd = os.open(path, flags)
        try:
            size = os.fstat(fd).st_size
            self._slots, rest = divmod(size - _HEADER, slot.itemsize)
            if self._slots < 1 or rest:
                raise ValueError(
                    f"{path.name}: {size} bytes; expected {_HEADER} and a multiple of "
                    f"{slot.itemsize}"
                )
            access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
            self._map = mmap.mmap(fd, size, access=access)
        finally:
            os.close(fd)
        self._count = np.frombuffer(self._map, _COUNTER, 1, 0)
        slots = np.frombuffer(self._map, slot, self._slots, _HEADER)
        self._numbers, self._records = slots["number"], slots["record"]

    @classmethod
    def create(cls, path: Path, dtype: np.dtype[Any], slots: int = SLOTS) -> Self:
        """Create the empty file (count 0) atomically and open it for writing.

        It holds `slots` records of a structured dtype; `since` can return all of them but the
        oldest.
        """
        size = _HEADER + slots * _slot(dtype).itemsize
        unfinished = path.with_name(f"{path.name}.{os.getpid()}-unfinished")
        try:
            with unfinished.open("xb") as file:
                file.write(bytes(size))
            os.link(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)
        return cls(path, dtype, writable=True)

    @classmethod
    def publish(cls, path: Path, dtype: np.dtype[Any]) -> Self:
        """Open or create the file for writing, for a writer that may start after its readers."""
        if path.exists():
            return cls.attach(path, dtype, writable=True)
        return cls.create(path, dtype)

    @classmethod
    def attach(cls, path: Path, dtype: np.dtype[Any], *, writable: bool = False) -> Self:
        """Open an existing file, read-only unless `writable`."""
        return cls(path, dtype, writable=writable)

    @property
    def count(self) -> int:
        """Records written so far."""
        return int(self._count[0])

    def write(self, record: np.void | tuple[Any, ...]) -> None:
        """Publish one record (a structured scalar, or a tuple in field order)."""
        number = int(self._count[0]) + 1
        slot = number % self._slots
        self._numbers[slot] = 0
        self._records[slot] = record
        self._numbers[slot] = number
        self._count[0] = number

    def read(self) -> np.void | None:
        """Return a copy of the latest complete record, or None before the first.

        A reader overtaken by the writer retries; the slots make that rare.
        """
        while True:
            number = int(self._count[0])
            if number == 0:
                return None
            slot = number % self._slots
            if int(self._numbers[slot]) != number:
                continue
            record = self._records[slot].copy()
            if int(self._numbers[slot]) == number:
                return record  # type: ignore[no-any-return]

    def since(self, number: int) -> tuple[np.ndarray, int]:
        """Return copies of the records after `number`, oldest first, and the newest's number.

        Fewer than the difference of the two numbers were returned if the writer has overwritten
        some, or overtook this reader.
        """
        newest = int(self._count[0])
        # The slot after the newest may be half written.
        numbers = np.arange(max(number + 1, newest - self._slots + 2, 1), newest + 1)
        slots = numbers % self._slots
        whole = self._numbers[slots] == numbers
        records = self._records[slots]
        whole &= self._numbers[slots] == numbers
        return records[whole], newest

    def close(self) -> None:
        """Release the mapping; may be called twice."""
        # Views of the mapping must be gone before it can be closed.
        self._records = self._numbers = self._count = np.zeros(1, _COUNTER)
        self._map.close()


class AwaitedRecord:
    """Reads a `SharedLatest` that another process creates, possibly later; or never (no path)."""

    def __init__(self, path: Path | None, dtype: np.dtype[Any]) -> None:
        self._path = path
        self._dtype = dtype
        self._record: SharedLatest | None = None
        self._read_to = 0
        self.missed = 0
        """Records that were overwritten between the last two calls of `unread`."""

    def _attached(self) -> SharedLatest | None:
        if self._record is None and self._path is not None:
            with contextlib.suppress(FileNotFoundError):
                self._record = SharedLatest.attach(self._path, self._dtype)
        return self._record

    @property
    def count(self) -> int:
        """Records written so far; 0 without a file."""
        record = self._attached()
        return 0 if record is None else record.count

    def read(self) -> np.void | None:
        """Return a copy of the latest complete record, or None before the first."""
        record = self._attached()
        return None if record is None else record.read()

    def unread(self) -> np.ndarray | None:
        """Return copies of all records since the last call, oldest first; None before the first.

        If none is new, the newest is returned again; the first call returns the newest alone.
        """
        record = self._attached()
        if record is None or record.count == 0:
            return None
        first = self._read_to == 0
        records, newest = record.since(max(self._read_to, record.count - 1 if first else 0))
        self.missed = 0 if first else newest - self._read_to - len(records)
        self._read_to = newest
        return records if len(records) else np.array([record.read()])

    def close(self) -> None:
        """Release the file; may be called twice."""
        if self._record is not None:
            self._record.close()
            self._record = None
