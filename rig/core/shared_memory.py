"""Latest value of a record, shared between processes by a memory-mapped file.

One process writes, any number read. A reader never blocks the writer and never sees a partial
record. A plain file in the run's own folder, unlike named shared memory, is removed with the folder
even if processes were killed.
"""

from __future__ import annotations

import contextlib
import mmap
import os
from pathlib import Path
from typing import Any

import numpy as np

# The count is raised last. A writer killed while writing leaves the count at the previous record,
# which lies in another slot and is complete, so a dead writer never hangs a reader.
_COUNTER = np.dtype("<u8")
_SLOTS = 8


def _layout(dtype: np.dtype[Any]) -> tuple[int, int]:
    """Return the slot stride and the file size [bytes], in whole cache lines."""
    stride = _COUNTER.itemsize + dtype.itemsize
    stride += -stride % 64
    return stride, 64 + _SLOTS * stride


class SharedLatest:
    """Structured record with one writer.

    Layout: u64 count of records written, then `_SLOTS` times (u64 record number, record).
    Record k lies in slot k % _SLOTS. Its number is written after its content: a reader that finds
    number k before and after copying has a complete record k.

    Args:
        path: The file; created by `create`, opened by `attach`.
        dtype: Structured dtype of one record.
    """

    def __init__(self, path: Path, dtype: np.dtype[Any], *, writable: bool) -> None:
        self._dtype = dtype
        stride, size = _layout(dtype)
        flags = os.O_RDWR if writable else os.O_RDONLY
        fd = os.open(path, flags)
        try:
            if os.fstat(fd).st_size != size:
                raise ValueError(f"{path.name}: {os.fstat(fd).st_size} bytes; expected {size}")
            access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
            self._map = mmap.mmap(fd, size, access=access)
        finally:
            os.close(fd)
        self._count = np.frombuffer(self._map, _COUNTER, 1, 0)
        self._numbers = [
            np.frombuffer(self._map, _COUNTER, 1, 64 + k * stride) for k in range(_SLOTS)
        ]
        self._records = [
            np.frombuffer(self._map, dtype, 1, 64 + k * stride + _COUNTER.itemsize)
            for k in range(_SLOTS)
        ]

    @classmethod
    def create(cls, path: Path, dtype: np.dtype[Any]) -> SharedLatest:
        """Create the empty file (count 0) atomically and open it for writing.

        Raises:
            FileExistsError: The file exists. Truncating it would kill readers that have it mapped
                (SIGBUS).
        """
        _, size = _layout(dtype)
        unfinished = path.with_name(f"{path.name}.{os.getpid()}-unfinished")
        try:
            with unfinished.open("xb") as file:
                file.write(bytes(size))
            os.link(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)
        return cls(path, dtype, writable=True)

    @classmethod
    def publish(cls, path: Path, dtype: np.dtype[Any]) -> SharedLatest:
        """Open or create the file for writing, for a writer that may start after its readers."""
        if path.exists():
            return cls.attach(path, dtype, writable=True)
        return cls.create(path, dtype)

    @classmethod
    def attach(cls, path: Path, dtype: np.dtype[Any], *, writable: bool = False) -> SharedLatest:
        """Open an existing file, read-only unless `writable`."""
        return cls(path, dtype, writable=writable)

    @property
    def count(self) -> int:
        """Records written so far."""
        return int(self._count[0])

    def write(self, record: np.void | tuple[Any, ...]) -> None:
        """Publish one record (a structured scalar, or a tuple in field order)."""
        number = int(self._count[0]) + 1
        slot = number % _SLOTS
        self._numbers[slot][0] = 0
        self._records[slot][0] = record
        self._numbers[slot][0] = number
        self._count[0] = number

    def read(self) -> np.void | None:
        """Return a copy of the latest complete record, or None before the first.

        A reader overtaken by the writer retries; the slots make that rare.
        """
        while True:
            number = int(self._count[0])
            if number == 0:
                return None
            slot = number % _SLOTS
            if int(self._numbers[slot][0]) != number:
                continue
            record = self._records[slot][0].copy()
            if int(self._numbers[slot][0]) == number:
                return record  # type: ignore[no-any-return]

    def close(self) -> None:
        """Release the mapping; may be called twice."""
        self._records.clear()
        self._numbers.clear()
        self._count = np.zeros(1, _COUNTER)
        self._map.close()


class AwaitedRecord:
    """Reads a `SharedLatest` that another process creates, possibly later.

    Args:
        path: The file; None: it never exists.
        dtype: Structured dtype of one record.
    """

    def __init__(self, path: Path | None, dtype: np.dtype[Any]) -> None:
        self._path = path
        self._dtype = dtype
        self._record: SharedLatest | None = None

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

    def close(self) -> None:
        """Release the file; may be called twice."""
        if self._record is not None:
            self._record.close()
            self._record = None
