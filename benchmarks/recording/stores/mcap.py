"""MCAP, the container of ROS 2 and Foxglove, through its own Python package."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from benchmarks.recording.frames import SHAPE, Frame, Image, decoded, number_in
from benchmarks.recording.stores import FrameStore, Numbers, Opened

_PERIOD_NS = 16_666_667


class Store(FrameStore):
    """One file.

    Its profile is `pixels`, `jpeg`, or `each` for JPEGs of which each is written as it comes, in a
    chunk of its own, so that a kill costs none; by default, chunks are of a megabyte.
    """

    def create(self, path: Path) -> None:
        """Create a new file."""
        self._file, self._count = path.open("wb"), 0
        packed = CompressionType.ZSTD if self.profile == "pixels" else CompressionType.NONE
        size = 1 if self.profile == "each" else 1 << 20  # by default
        self._writer = Writer(self._file, compression=packed, chunk_size=size)
        self._writer.start()
        self._channel = self._writer.register_channel("/camera", "frame", 0)

    def append(self, frame: Frame, t_ns: int) -> None:
        """Append one frame."""
        data = frame if isinstance(frame, bytes) else frame.tobytes()
        # Evenly spaced times, from which the reader finds a window.
        at_ns = self._count * _PERIOD_NS
        self._writer.add_message(self._channel, at_ns, data, at_ns, self._count)
        self._count += 1
        if self.profile == "each":
            self._file.flush()

    def close(self) -> None:
        """Write the summary and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

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
                messages = reader.iter_messages(starting_at=start, ending_before=end)
                frames = (message.data for _, _, message in messages)
                if self.profile != "pixels":
                    return decoded(frames, n)
                out = np.empty((n, *SHAPE), np.uint8)
                for image, data in zip(out, frames, strict=True):
                    image[...] = _image(data)
                return out

            yield count, read

    def left(self, path: Path) -> Numbers:
        """Return the frames that the seeking reader finds; it needs the summary at the end."""
        with path.open("rb") as file:
            messages = make_reader(file).iter_messages()
            return [self._number(message) for _, _, message in messages]

    def repaired(self, path: Path) -> Numbers:
        """Return the frames found record by record, which is how `mcap recover` works."""
        numbers: Numbers = []
        with path.open("rb") as file:
            try:
                for record in StreamReader(file).records:
                    if isinstance(record, Message):
                        numbers.append(self._number(record))
            except (McapError, EOFError, ValueError):
                return numbers  # truncated end of the file
        return numbers

    def _number(self, message: Message) -> int | None:
        return number_in(_image(message.data) if self.profile == "pixels" else message.data)


def _image(data: bytes) -> Image:
    return np.frombuffer(data, np.uint8).reshape(SHAPE)
