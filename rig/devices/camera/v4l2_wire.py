"""V4L2 capture by memory-mapped buffers: the ioctls that a camera's driver needs.

Structures and numbers are those of linux/videodev2.h. Only 64-bit Linux is supported.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
import select
from dataclasses import dataclass

_CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_MMAP = 1  # V4L2_MEMORY_MMAP
_BUFFERS = 8

# V4L2_CID_GAIN, V4L2_CID_EXPOSURE_AUTO and V4L2_CID_EXPOSURE_ABSOLUTE, which counts 100 us.
GAIN, EXPOSURE_AUTO, EXPOSURE_ABSOLUTE = 0x00980913, 0x009A0901, 0x009A0902
EXPOSURE_UNIT = 1e-4
# V4L2_EXPOSURE_MANUAL.
MANUAL = 1

# Flags of a buffer: error, clock of its time, and the moment that the time is of.
_ERROR, _CLOCK, _MONOTONIC, _STAMPED, _START = 0x40, 0xE000, 0x2000, 0x70000, 0x10000


class _Pix(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_uint32)
        for name in (
            "width",
            "height",
            "pixelformat",
            "field",
            "bytesperline",
            "sizeimage",
            "colorspace",
            "priv",
            "flags",
            "ycbcr_enc",
            "quantization",
            "xfer_func",
        )
    ]


class _FormatUnion(ctypes.Union):
    _fields_ = [("pix", _Pix), ("raw", ctypes.c_uint8 * 200), ("align", ctypes.c_uint64)]


class _Format(ctypes.Structure):
    _fields_ = [("type", ctypes.c_uint32), ("fmt", _FormatUnion)]


class _Capture(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_uint32)
        for name in ("capability", "mode", "numerator", "denominator", "extended", "buffers")
    ]


class _ParmUnion(ctypes.Union):
    _fields_ = [("capture", _Capture), ("raw", ctypes.c_uint8 * 200)]


class _Parm(ctypes.Structure):
    _fields_ = [("type", ctypes.c_uint32), ("parm", _ParmUnion)]


class _Request(ctypes.Structure):
    _fields_ = [
        ("count", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class _Time(ctypes.Structure):
    _fields_ = [("sec", ctypes.c_int64), ("usec", ctypes.c_int64)]


class _Buffer(ctypes.Structure):
    _fields_ = [
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("bytesused", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("timestamp", _Time),
        ("timecode", ctypes.c_uint8 * 16),
        ("sequence", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("offset", ctypes.c_uint64),
        ("length", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class _Control(ctypes.Structure):
    _fields_ = [("id", ctypes.c_uint32), ("value", ctypes.c_int32)]


def _code(direction: int, number: int, kind: type[ctypes.Structure] | type[ctypes.c_int]) -> int:
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


_S_FMT, _S_PARM = _code(3, 5, _Format), _code(3, 22, _Parm)
_REQBUFS, _QUERYBUF = _code(3, 8, _Request), _code(3, 9, _Buffer)
_QBUF, _DQBUF = _code(3, 15, _Buffer), _code(3, 17, _Buffer)
_STREAMON, _STREAMOFF = _code(1, 18, ctypes.c_int), _code(1, 19, ctypes.c_int)
_G_CTRL, _S_CTRL = _code(3, 27, _Control), _code(3, 28, _Control)


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
    """An open V4L2 capture node.

    Args:
        path: The device file.
    """

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._maps: list[mmap.mmap] = []

    def set_format(self, width: int, height: int, fourcc: str) -> tuple[int, int, str]:
        """Ask for a format; return the width, height and format that the camera chose."""
        found = _Format(type=_CAPTURE)
        pix = found.fmt.pix
        pix.width, pix.height = width, height
        pix.pixelformat = int.from_bytes(fourcc.encode("latin-1"), "little")
        fcntl.ioctl(self._fd, _S_FMT, found)
        return pix.width, pix.height, pix.pixelformat.to_bytes(4, "little").decode("latin-1")

    def set_rate(self, rate_hz: float) -> float:
        """Ask for a frame rate; return the one that the camera chose [Hz]."""
        found = _Parm(type=_CAPTURE)
        capture = found.parm.capture
        capture.numerator, capture.denominator = 1000, round(1000 * rate_hz)
        fcntl.ioctl(self._fd, _S_PARM, found)
        return float(capture.denominator / capture.numerator) if capture.numerator else 0.0

    def set_control(self, number: int, value: int) -> int:
        """Set a control; return the value that the camera took."""
        control = _Control(number, value)
        fcntl.ioctl(self._fd, _S_CTRL, control)
        fcntl.ioctl(self._fd, _G_CTRL, control)
        return int(control.value)

    def start(self) -> None:
        """Map the buffers and start the stream."""
        request = _Request(count=_BUFFERS, type=_CAPTURE, memory=_MMAP)
        fcntl.ioctl(self._fd, _REQBUFS, request)
        if request.count < 2:
            raise OSError(errno.ENOMEM, "the driver has no memory for buffers")
        for index in range(request.count):
            buffer = _Buffer(index=index, type=_CAPTURE, memory=_MMAP)
            fcntl.ioctl(self._fd, _QUERYBUF, buffer)
            at = buffer.offset & 0xFFFFFFFF
            self._maps.append(mmap.mmap(self._fd, buffer.length, offset=at))
            fcntl.ioctl(self._fd, _QBUF, buffer)
        fcntl.ioctl(self._fd, _STREAMON, ctypes.c_int(_CAPTURE))

    def next_frame(self, seconds: float) -> Frame | None:
        """Return the next frame, or None if none comes within `seconds`."""
        events = self._poll.poll(max(round(1e3 * seconds), 0))
        if not events:
            return None
        buffer = _Buffer(type=_CAPTURE, memory=_MMAP)
        try:
            fcntl.ioctl(self._fd, _DQBUF, buffer)
        except BlockingIOError:
            if events[0][1] & (select.POLLERR | select.POLLHUP):
                raise OSError(errno.ENODEV, os.strerror(errno.ENODEV)) from None
            return None
        time = buffer.timestamp.sec + 1e-6 * buffer.timestamp.usec
        flags = buffer.flags
        frame = Frame(
            self._maps[buffer.index][: buffer.bytesused],
            int(buffer.sequence),
            time if flags & _CLOCK == _MONOTONIC else float("nan"),
            flags & _STAMPED == _START,
            bool(flags & _ERROR),
        )
        fcntl.ioctl(self._fd, _QBUF, buffer)
        return frame

    def close(self) -> None:
        """Stop the stream and release the node; may be called twice."""
        if self._fd < 0:
            return
        with contextlib.suppress(OSError):
            fcntl.ioctl(self._fd, _STREAMOFF, ctypes.c_int(_CAPTURE))
        for mapped in self._maps:
            mapped.close()
        self._maps.clear()
        os.close(self._fd)
        self._fd = -1
