"""Motion JPEG in an AVI file: the camera's own JPEG files, taken out without decoding them.

RIFF is a tree of chunks `FOURCC | uint32 size | content`, padded to even sizes; `RIFF` and `LIST`
chunks hold a form type and further chunks. A stream's header is `strh` (its kind, its codec, its
rate as dwRate / dwScale) with `strf` (BITMAPINFOHEADER) beside it, both in `LIST hdrl`; its frames
are the chunks `NNdc` or `NNdb` of `LIST movi`, NN being the number of the stream. Files beyond 1 GB
go on in further `RIFF AVIX` chunks (OpenDML). Source: Microsoft, "AVI RIFF File Reference"; Matrox,
"OpenDML AVI File Format Extensions", 1.02.
"""

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from recorder.errors import SessionError

_HEAD = struct.Struct("<4sI")
_STRH = struct.Struct("<4s4sIHHIIIII")
_GROUPS = (b"RIFF", b"LIST")
_MJPEG = (b"MJPG", b"mjpg")


@dataclass(frozen=True, slots=True)
class MotionJpeg:
    """The frames of an AVI file."""

    rate_hz: float
    """Frames per second, by the stream's header."""
    frames: list[bytes]
    """One JPEG file per frame; empty where the writer dropped one and left its place."""


def read_avi(path: Path) -> MotionJpeg | None:
    """Return the frames of an AVI file with a Motion JPEG stream; None of any other file.

    Raises:
        SessionError: The file is cut short, or its stream says no rate.
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        if file.read(12)[:4] != b"RIFF":
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _read(path, data)


def _read(path: Path, data: mmap.mmap) -> MotionJpeg | None:
    if data[8:12] != b"AVI ":
        return None
    number, rate_hz = -1, 0.0
    streams = 0
    frames: list[bytes] = []
    for kind, start, size in _chunks(path, data, 0, len(data)):
        if kind == b"strh":
            if data[start : start + 4] == b"vids" and number < 0:
                codec = data[start + 4 : start + 8]
                number, rate_hz = streams, _rate(path, data, start, size)
                mjpeg = codec in _MJPEG
            streams += 1
        elif kind == b"strf" and number == streams - 1:
            # The header's own codec name may be empty; that of the picture format holds then.
            mjpeg = mjpeg or data[start + 16 : start + 20] in _MJPEG
        elif number >= 0 and kind in (b"%02ddc" % number, b"%02ddb" % number):
            if not mjpeg:
                return None
            frames.append(bytes(data[start : start + size]))
    if number < 0 or not frames:
        raise SessionError(f"{path.name}: an AVI file without a frame of video")
    return MotionJpeg(rate_hz, frames)


def _chunks(path: Path, data: mmap.mmap, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, place and size of every chunk that is no group, in the order of the file."""
    while at + _HEAD.size <= end:
        kind, size = _HEAD.unpack_from(data, at)
        start = at + _HEAD.size
        if start + size > end:
            missing = start + size - end
            raise SessionError(
                f"{path.name}: cut short: chunk {kind!r} at byte {at} lacks {missing} bytes"
            )
        if kind in _GROUPS:
            yield from _chunks(path, data, start + 4, start + size)
        else:
            yield kind, start, size
        at = start + size + size % 2


def _rate(path: Path, data: mmap.mmap, start: int, size: int) -> float:
    if size < _STRH.size:
        raise SessionError(f"{path.name}: stream header of {size} bytes; expected {_STRH.size}")
    fields = _STRH.unpack_from(data, start)
    scale, rate = fields[6], fields[7]
    if not scale or not rate:
        raise SessionError(f"{path.name}: its stream says no rate; say --fps")
    return float(rate / scale)
