"""Emulated network camera that plays recorded JPEG files: see rig/mock/player.py.

OpenCV reads one frame to open the stream and drops it, and the driver checks a second one before
it records. Both get the first recorded picture. Then the recorded files are sent unchanged.
"""

from __future__ import annotations

import socket

from recorder import SessionError
from rig.devices.camera.jpeg import BOUNDARY, multipart
from rig.devices.playback.wire import Listener, RecordedStream

PORT = 8081
_LEAD_IN = 2
_REQUEST_BYTES_MAX = 1 << 16
_TORN = b"\xff\xd8"


class MjpegPlayback:
    """Emulated camera that sends MJPEG over HTTP.

    Args:
        recorded: A camera stream that holds JPEG files.
        host: Address to listen on.
    """

    window = 32
    """The driver keeps 120 frames for a late recorder."""

    def __init__(self, recorded: RecordedStream, host: str) -> None:
        self._recorded = recorded
        self._listener = Listener(host, PORT, self._greet)

    @property
    def address(self) -> str:
        """URL of the stream."""
        return f"http://{self._listener.host}:{PORT}/"

    def start(self) -> None:
        """Start listening.

        Raises:
            OSError: The address is not available.
        """
        self._listener.start()

    def send(self, place: int) -> None:
        """Send one frame, its bytes as recorded.

        Raises:
            OSError: The client is gone.
        """
        self._listener.send(multipart(self._jpeg(self._recorded.rows[place])))

    def idle(self) -> None:
        """Do nothing: a camera sends only frames."""

    def wake(self) -> None:
        """Send a torn frame: OpenCV returns from its wait, and the driver drops it."""
        if self._listener.connected:
            self._listener.send(multipart(_TORN))

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._listener.close()

    def _jpeg(self, row: int) -> bytes:
        jpeg = self._recorded.stream.jpeg(row)
        if jpeg is None:
            raise SessionError(
                f"streams/{self._recorded.stream.name}: stored as pixels, not as JPEG"
            )
        return jpeg

    def _greet(self, client: socket.socket) -> bool:
        request = b""
        while b"\r\n\r\n" not in request:
            received = client.recv(4096)
            if not received or len(request) > _REQUEST_BYTES_MAX:
                return False
            request += received
        client.sendall(
            b"HTTP/1.0 200 OK\r\nCache-Control: no-store\r\n"
            b"Content-Type: multipart/x-mixed-replace; boundary=" + BOUNDARY.encode() + b"\r\n\r\n"
        )
        first = min(self._recorded.rows.start, len(self._recorded.stream) - 1)
        for _ in range(_LEAD_IN):
            client.sendall(multipart(self._jpeg(first)))
        return True
