"""CPU time of recording one JPEG frame, by part."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from time import thread_time_ns
from typing import Any
from unittest import mock

import google_crc32c

from benchmarks.recording import stores
from benchmarks.recording.frames import GelFrames
from benchmarks.recording.measure import cpu_seconds

# Frames made before the measurement and used in turn.
_DIFFERENT = 64
# Bytes from which a write or checksum is of a frame, and not of a row.
_LARGE = 16_384
# Parts of a frame's record; a write of more is of pages of zeros.
_PARTS = 3
_FLUSH = "flushing to the disk, in the background"
_FILES = "creating and renaming files and folders"


def measure(entry: stores.Entry, path: Path, *, frames: int) -> dict[str, float]:
    """Record JPEG frames; return the CPU time of each part [us a frame].

    Timing a call costs up to half a microsecond, which is part of the time of that call's part.
    """
    made = GelFrames()
    jpegs = [made.jpeg(number) for number in range(_DIFFERENT)]
    spent: Counter[str] = Counter()
    appending = threading.get_ident()

    def timed(real: Callable[..., Any], part: Callable[[tuple[Any, ...]], str]) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            start = thread_time_ns()
            try:
                return real(*args, **options)
            finally:
                name = part(args)
                if threading.get_ident() == appending or name == _FLUSH:
                    spent[name] += thread_time_ns() - start

        return call

    def of_write(args: tuple[Any, ...]) -> str:
        return "copying the frame into the file" if len(args[1]) > _LARGE else "row of the journal"

    def of_vector(args: tuple[Any, ...]) -> str:
        zeros = len(args[1]) > _PARTS
        return "making the file longer by zeros" if zeros else "copying the frame into the file"

    def of_sum(args: tuple[Any, ...]) -> str:
        return "checksum of the frame" if len(args[0]) > _LARGE else ""

    parts: dict[str, Callable[[tuple[Any, ...]], str]] = {
        "pwrite": of_write,
        "pwritev": of_vector,
        "fdatasync": lambda _: _FLUSH,
        "fsync": lambda _: _FLUSH,
        **dict.fromkeys(("open", "close", "mkdir", "replace", "ftruncate"), lambda _: _FILES),
    }
    store = entry.make()  # imports its library
    total = cpu_seconds()
    appender = store.create(path)
    opened = cpu_seconds()
    with (
        mock.patch.multiple(os, **{name: timed(getattr(os, name), parts[name]) for name in parts}),
        mock.patch.object(google_crc32c, "value", timed(google_crc32c.value, of_sum)),
    ):
        start = thread_time_ns()
        for number in range(frames):
            appender.append(jpegs[number % _DIFFERENT], number)
        appended = thread_time_ns() - start
        background = (cpu_seconds() - opened) * 1e9 - appended - spent[_FLUSH]
    flushed = spent.pop(_FLUSH)
    del spent[""]
    found: dict[str, float] = dict(spent.most_common())
    found["the rest of `append`: Python"] = appended - sum(found.values())
    found[_FLUSH] = flushed
    found["the rest of the background: rows as chunks, metadata, Python"] = background
    closing = cpu_seconds()
    appender.close()
    end = cpu_seconds()
    found["creating the session"] = (opened - total) * 1e9
    found["closing it"] = (end - closing) * 1e9
    return {name: ns / frames / 1e3 for name, ns in found.items()}
