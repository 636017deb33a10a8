"""When a UDP packet arrived, told by the kernel.

A thread that waits for the interpreter's lock takes a packet some milliseconds after it came (in a
busy process 7 ms in the median, 37 ms at worst, measured at 1 kHz). The kernel stamps each packet
as it comes, on the UTC clock; that is carried over to the monotonic clock here.
"""

from __future__ import annotations

import contextlib
import socket
import struct

from rig.clock import SECOND_NS, Clock, ClockAnchor

_SO_TIMESTAMPNS = 35
# Linux' number; the socket module does not name it before Python 3.14.
_TIMESPEC = struct.Struct("@ll")
_ANCHOR_NS = SECOND_NS // 10
# UTC is stepped and slewed: the tie between the clocks is never older than this.
_AGE_MAX_NS = 10 * SECOND_NS


class StampedSocket:
    """A UDP socket whose packets come with their time of arrival.

    Args:
        udp: The socket; its time-out holds.
        clock: Gives the time of a packet that the kernel did not stamp, or whose stamp lies ahead
            or more than 10 s behind because UTC was set.
    """

    def __init__(self, udp: socket.socket, clock: Clock) -> None:
        self._udp = udp
        self._clock = clock
        self._anchor = ClockAnchor.take()
        if hasattr(socket, "SO_PRIORITY"):  # Linux
            with contextlib.suppress(OSError):
                udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def receive(self, size: int) -> tuple[bytes, int]:
        """The next packet and its arrival [ns].

        Raises:
            OSError: As `socket.recv`, TimeoutError included.
        """
        packet, ancillary, _, _ = self._udp.recvmsg(size, 64)
        now_ns = self._clock.now_ns()
        if not 0 <= now_ns - self._anchor.t0_ns < _ANCHOR_NS:
            self._anchor = ClockAnchor.take()
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack(data)
                utc_ns = seconds * SECOND_NS + nanoseconds
                t_ns = utc_ns - self._anchor.utc_ns + self._anchor.t0_ns
                if now_ns - _AGE_MAX_NS < t_ns <= now_ns:
                    return packet, t_ns
        return packet, now_ns
