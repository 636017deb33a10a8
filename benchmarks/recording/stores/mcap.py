"""MCAP, the container of ROS 2 and Foxglove, through its own Python package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import simplejpeg
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from benchmarks.recording.frames import HEIGHT, WIDTH
from benchmarks.recording.stores import (
    Appender,
    Frame,
    FrameStore,
    Image,
    Numbers,
    Opened,
    number_in,
)

_PERIOD_NS = 16_666_667


class _Appender(Appender):
    def __init__(self, path: Path, jpeg: bool, at_once: bool) -> None:
        self._at_once = at_once
        self._file = path.open("wb")
        packed = CompressionType.NONE if jpeg else CompressionType.ZSTD
        if at_once:
            self._writer = Writer(self._file, compression=packed, chunk_size=1)
        else:
            self._writer = Writer(self._file, compression=packed)
        self._writer.start()
        self._channel = self._writer.register_channel("/camera", "frame", 0)
        self._count = 0

    def append(self, frame: Frame, t_ns: int) -> None:
        data = frame if isinstance(frame, bytes) else frame.tobytes()
        # Evenly spaced times, from which the reader finds a window.
        at_ns = self._count * _PERIOD_NS
        self._writer.add_message(self._channel, at_ns, data, at_ns, self._count)
        self._count += 1
        if self._at_once:
            self._file.flush()

    def close(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()


class Store(FrameStore):
    """One file.

    Args:
        profile: `pixels`, `jpeg`, or `each` for JPEGs of which each is written as it comes, in a
            chunk of its own, so that a kill costs none; by default, chunks are of a megabyte.
    """

    def __init__(self, profile: str) -> None:
        self._at_once = profile == "each"
        self._jpeg = profile != "pixels"

    def create(self, path: Path) -> _Appender:
        """Create a new file."""
        return _Appender(path, self._jpeg, self._at_once)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            count = 0
            if summary is not None and summary.statistics is not None:
                count = summary.statistics.message_count

            def read(first: int, n: int) -> Image:
                start, end = first * _PERIOD_NS, (first + n) * _PERIOD_NS
                out = np.empty((n, HEIGHT, WIDTH, 3), np.uint8)
                messages = reader.iter_messages(starting_at=start, ending_before=end)
                for image, (_, _, message) in zip(out, messages, strict=True):
                    if self._jpeg:
                        simplejpeg.decode_jpeg(message.data, buffer=image)
                    else:
                        image[...] = _image(message.data)
                return out

            yield count, read

    def left(self, path: Path) -> Numbers:
        """Return the frames that the seeking reader finds; it needs the summary at the end."""
        with path.open("rb") as file:
            messages = make_reader(file).iter_messages()
            return [self._number(message) for _, _, message in messages]

    def repaired(self, path: Path) -> Numbers:
        """Return the frames found record by record, which is how `mcap recover` works."""
        found: Numbers = []
        with path.open("rb") as file:
            try:
                for record in StreamReader(file).records:
                    if isinstance(record, Message):
                        found.append(self._number(record))
            except (McapError, EOFError, ValueError):
                return found  # truncated end of the file
        return found

    def _number(self, message: Message) -> int | None:
        return number_in(message.data if self._jpeg else _image(message.data))


def _image(data: bytes) -> Image:
    return np.frombuffer(data, np.uint8).reshape(HEIGHT, WIDTH, 3)
