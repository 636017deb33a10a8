"""V4L2 capture by memory-mapped buffers: the ioctls that a camera's driver needs.

Structures and numbers are those of linux/videodev2.h. Only 64-bit Linux is supported.
"""

import contextlib
import errno
import fcntl
import mmap
import os
import select
import struct
from dataclasses import dataclass

_CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_MMAP = 1  # V4L2_MEMORY_MMAP
_BUFFERS = 8

# V4L2_CID_GAIN, V4L2_CID_EXPOSURE_AUTO and V4L2_CID_EXPOSURE_ABSOLUTE, which counts 100 us.
GAIN, EXPOSURE_AUTO, EXPOSURE_ABSOLUTE = 0x00980913, 0x009A0901, 0x009A0902
EXPOSURE_UNIT = 1e-4
# V4L2_EXPOSURE_MANUAL.
MANUAL = 1
# V4L2_CID_AUTO_WHITE_BALANCE and V4L2_CID_FOCUS_AUTO.
WHITE_BALANCE_AUTO, FOCUS_AUTO = 0x0098090C, 0x009A090C

# Flags of a buffer: error, clock of its time, and the moment that the time is of.
_ERROR, _CLOCK, _MONOTONIC, _STAMPED, _START = 0x40, 0xE000, 0x2000, 0x70000, 0x10000


# The structures, with fields that are not read left out (x); the sizes are those of 64 bits.
# v4l2_format: type | width, height, pixelformat, ...
_FORMAT = struct.Struct("@I4x3I188x")
# v4l2_streamparm: type | capability, mode, numerator, denominator of the time of a frame, ...
_PARM = struct.Struct("@5I184x")
# v4l2_requestbuffers: count, type, memory
_REQUEST = struct.Struct("@3I8x")
# v4l2_buffer: index, type, bytesused, flags | seconds, microseconds | sequence, memory | offset |
# length
_BUFFER = struct.Struct("@4I8x2q16x2IQI12x")
# v4l2_control: id, value
_CONTROL = struct.Struct("@Ii")
_INT = struct.Struct("@i")


def _code(direction: int, number: int, content: struct.Struct) -> int:
    return direction << 30 | content.size << 16 | ord("V") << 8 | number


_S_FMT, _S_PARM = _code(3, 5, _FORMAT), _code(3, 22, _PARM)
_REQBUFS, _QUERYBUF = _code(3, 8, _REQUEST), _code(3, 9, _BUFFER)
_QBUF, _DQBUF = _code(3, 15, _BUFFER), _code(3, 17, _BUFFER)
_STREAMON, _STREAMOFF = _code(1, 18, _INT), _code(1, 19, _INT)
_G_CTRL, _S_CTRL = _code(3, 27, _CONTROL), _code(3, 28, _CONTROL)


@dataclass(frozen=True, slots=True)
class Frame:
    """One buffer that the driver filled."""

    data: bytes
    """Bytes of the picture."""
    sequence: int
    """Number of the frame, modulo 2**32; the driver counts those that it had no buffer for."""
    time: float
    """The driver's time of the frame [s]; NaN if it is not of CLOCK_MONOTONIC."""
    at_start: bool
    """True if the time is that of the start of exposure; else it is of the end of the frame."""
    damaged: bool
    """True if the driver says that the picture is not whole."""


class Node:
    """An open V4L2 capture node."""

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._maps: list[mmap.mmap] = []

    def set_format(self, width: int, height: int, fourcc: str) -> tuple[int, int, str]:
        """Ask for a format; return the width, height and format that the camera chose."""
        code = int.from_bytes(fourcc.encode("latin-1"), "little")
        _, width, height, code = self._ioctl(_S_FMT, _FORMAT, _CAPTURE, width, height, code)
        return width, height, code.to_bytes(4, "little").decode("latin-1")

    def set_rate(self, rate_hz: float) -> float:
        """Ask for a frame rate; return the one that the camera chose [Hz]."""
        settings = (_CAPTURE, 0, 0, 1000, round(1000 * rate_hz))
        *_, numerator, denominator = self._ioctl(_S_PARM, _PARM, *settings)
        return float(denominator / numerator) if numerator else 0.0

    def set_control(self, number: int, value: int) -> int:
        """Set a control; return the value that the camera took."""
        self._ioctl(_S_CTRL, _CONTROL, number, value)
        return self._ioctl(_G_CTRL, _CONTROL, number, value)[1]

    def automatic(self) -> list[str]:
        """Return which of exposure, white balance and focus the camera sets by itself."""
        manual = {"exposure": (EXPOSURE_AUTO, MANUAL), "white balance": (WHITE_BALANCE_AUTO, 0)}
        manual["focus"] = (FOCUS_AUTO, 0)
        on = []
        for name, (number, off) in manual.items():
            with contextlib.suppress(OSError):  # the camera has no such control
                if self._ioctl(_G_CTRL, _CONTROL, number, 0)[1] != off:
                    on.append(name)
        return on

    def start(self) -> None:
        """Map the buffers and start the stream."""
        count, *_ = self._ioctl(_REQBUFS, _REQUEST, _BUFFERS, _CAPTURE, _MMAP)
        if count < 2:
            raise OSError(errno.ENOMEM, "the driver has no memory for buffers")
        for index in range(count):
            *_, offset, length = self._ioctl(_QUERYBUF, _BUFFER, *_buffer(index))
            self._maps.append(mmap.mmap(self._fd, length, offset=offset & 0xFFFFFFFF))
            self._ioctl(_QBUF, _BUFFER, *_buffer(index))
        self._ioctl(_STREAMON, _INT, _CAPTURE)

    def next_frame(self, seconds: float) -> Frame | None:
        """Return the next frame, or None if none comes within `seconds`."""
        events = self._poll.poll(max(round(1e3 * seconds), 0))
        if not events:
            return None
        try:
            index, _, used, flags, whole, micro, sequence, *_ = self._ioctl(
                _DQBUF, _BUFFER, *_buffer(0)
            )
        except BlockingIOError:
            if events[0][1] & (select.POLLERR | select.POLLHUP):
                raise OSError(errno.ENODEV, os.strerror(errno.ENODEV)) from None
            return None
        time = whole + 1e-6 * micro
        frame = Frame(
            self._maps[index][:used],
            sequence,
            time if flags & _CLOCK == _MONOTONIC else float("nan"),
            flags & _STAMPED == _START,
            bool(flags & _ERROR),
        )
        self._ioctl(_QBUF, _BUFFER, *_buffer(index))
        return frame

    def close(self) -> None:
        """Stop the stream and release the node; may be called twice."""
        if self._fd < 0:
            return
        with contextlib.suppress(OSError):
            self._ioctl(_STREAMOFF, _INT, _CAPTURE)
        for mapped in self._maps:
            mapped.close()
        self._maps.clear()
        os.close(self._fd)
        self._fd = -1

    def _ioctl(self, code: int, content: struct.Struct, *values: int) -> tuple[int, ...]:
        """Make the ioctl of this code with a structure; return what the driver left in it."""
        buffer = bytearray(content.pack(*values))
        fcntl.ioctl(self._fd, code, buffer)
        return content.unpack(buffer)


def _buffer(index: int) -> tuple[int, ...]:
    """Return the fields that name one of the mapped buffers."""
    return (index, _CAPTURE, 0, 0, 0, 0, 0, _MMAP, 0, 0)
