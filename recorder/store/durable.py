"""File changes that are atomic and durable, also after a power failure."""

from __future__ import annotations

import json
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.store.documents import read_document
from recorder.store.files import LOCAL

# Suffix of a file that is still being written and not yet valid.
TEMPORARY = ".tmp"


def sync_directory(path: Path) -> None:
    """Make the names in a directory as durable as the files that they refer to."""
    _sync(path)


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_tree(path: Path) -> None:
    """Make every file and every name below a directory durable."""
    for folder, _, names in os.walk(path, topdown=False):
        for name in names:
            _sync(Path(folder, name))
        _sync(Path(folder))


def replace_file(path: Path, data: bytes, *, temporary: Path | None = None) -> None:
    """Write `data` to `path` atomically: a reader sees the old or the new content.

    Args:
        path: The file.
        data: Its content.
        temporary: Name used while writing, in the same directory, if several writers may write the
            same file at the same time; `path` with the suffix `TEMPORARY` if None.
    """
    temporary = temporary or path.with_name(path.name + TEMPORARY)
    fd = os.open(temporary, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o644)
    try:
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(fd, rest) :]
        os.fsync(fd)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    finally:
        os.close(fd)
    temporary.replace(path)
    sync_directory(path.parent)


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Replace a JSON file atomically.

    Numpy scalars and arrays become numbers and lists.
    """
    replace_file(path, json_bytes(path, document))


def json_bytes(path: Path, document: dict[str, Any]) -> bytes:
    """Return the content of a JSON file as `write_json` writes it."""
    try:
        return json.dumps(document, indent=2, allow_nan=False, default=_plain).encode()
    except (TypeError, ValueError) as error:
        raise SessionError(f"{path}: not storable as JSON: {error}") from error


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file."""
    return read_document(LOCAL, path)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} is not JSON")


# One thread for all slow work: sealing, encoding blocks, flushing to disk.


class Background:
    """Thread that runs jobs in order, and a flush every `interval` seconds.

    A job that fails, for whatever reason, remains first in the queue, with its error in `failure`;
    no other job runs until `drain`. The thread never ends with jobs undone and no `failure`.
    """

    def __init__(self, flush: Callable[[], None], *, interval: float, name: str) -> None:
        """Start the thread."""
        self.failure: BaseException | None = None
        self._flush = flush
        self._interval = interval
        self._jobs: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], None]) -> None:
        """Queue a job. A job that fails must be safe to run again."""
        self._jobs.append(job)
        self._wake.set()

    def stop(self) -> None:
        """End the thread once all queued jobs are done or one failed. May be called twice."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def drain(self) -> None:
        """Run the remaining jobs in the calling thread, after `stop`."""
        while self._jobs:
            self._jobs[0]()
            self._jobs.popleft()
        self.failure = None

    def _run(self) -> None:
        due = time.monotonic() + self._interval
        while not self._stopping:
            self._wake.wait(max(due - time.monotonic(), 0.0))
            self._wake.clear()
            try:
                while self._jobs and self.failure is None:
                    self._jobs[0]()
                    self._jobs.popleft()
                if time.monotonic() >= due:
                    due = time.monotonic() + self._interval
                    if self.failure is None:
                        self._flush()
            except BaseException as error:  # the thread that appends must learn of any error
                self.failure = error
