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

from benchmarks.recording.frames import HEIGHT, WIDTH, number_in_jpeg, number_in_pixels
from benchmarks.recording.stores import Image, Numbers, Opened

_PERIOD_NS = 16_666_667


class _Appender:
    def __init__(self, path: Path, profile: str, at_once: bool) -> None:
        self._at_once = at_once
        self._file = path.open("wb")
        packed = CompressionType.NONE if profile == "jpeg" else CompressionType.ZSTD
        if at_once:
            self._writer = Writer(self._file, compression=packed, chunk_size=1)
        else:
            self._writer = Writer(self._file, compression=packed)
        self._writer.start()
        self._channel = self._writer.register_channel("/camera", profile, 0)
        self._count = 0

    def append(self, frame: Image | bytes, t_ns: int) -> None:
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


class Mcap:
    """One file.

    Args:
        profile: `pixels` or `jpeg`.
        chunks: `at-once` to write every message as it comes, in a chunk of its own, so that a kill
            costs none; by default, chunks of a megabyte.
    """

    def __init__(self, profile: str, chunks: str = "") -> None:
        self._at_once = chunks == "at-once"
        self._number = _jpeg_number if profile == "jpeg" else _pixels_number
        self._decode = simplejpeg.decode_jpeg if profile == "jpeg" else _image
        self._profile = profile

    def create(self, path: Path) -> _Appender:
        """Create a new file."""
        return _Appender(path, self._profile, self._at_once)

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
                found = reader.iter_messages(starting_at=start, ending_before=end)
                return np.stack([self._decode(message.data) for _, _, message in found])

            yield count, read

    def left(self, path: Path) -> Numbers:
        """Return the frames that the seeking reader finds; it needs the summary at the end."""
        with path.open("rb") as file:
            messages = make_reader(file).iter_messages()
            return [self._number(message.data) for _, _, message in messages]

    def repaired(self, path: Path) -> Numbers:
        """Return the frames found record by record, which is how `mcap recover` works."""
        found: Numbers = []
        with path.open("rb") as file:
            try:
                for record in StreamReader(file).records:
                    if isinstance(record, Message):
                        found.append(self._number(record.data))
            except (McapError, EOFError, ValueError):
                return found  # truncated end of the file
        return found


def _image(data: bytes) -> Image:
    return np.frombuffer(data, np.uint8).reshape(HEIGHT, WIDTH, 3)


def _pixels_number(data: bytes) -> int | None:
    return number_in_pixels(_image(data))


def _jpeg_number(data: bytes) -> int | None:
    return number_in_jpeg(data)
