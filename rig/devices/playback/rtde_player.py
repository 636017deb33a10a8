"""Emulated controller that plays recorded poses by RTDE: see rig/mock/player.py.

It only reports: no script runs, nothing moves. Quantities that a session does not store (speeds,
states) are reported as in normal operation. While no pose is due it sends the client text messages,
as a controller may: a reader that receives nothing for a second fails.
"""

from __future__ import annotations

import socket

from rig.devices.arm import rtde
from rig.devices.arm.emulated_controller import VERSION
from rig.devices.playback.wire import Listener, RecordedStream

_RECIPE = 1
_TEXT = b"replay: no pose is due"
_SOURCE = b"tactile-rig"
_INFO = 3
_WAITING = bytes([len(_TEXT)]) + _TEXT + bytes([len(_SOURCE)]) + _SOURCE + bytes([_INFO])
# runtime_state of a running program.
_PLAYING = 2
# safety_status_bits: bit 0, normal mode.
_NORMAL = 1
# robot_mode.
_RUNNING = 7


class RtdePlayback:
    """Emulated controller that sends RTDE data packages.

    Args:
        recorded: A stream of poses, or of the arm's wrench.
        host: Address to listen on.
    """

    window = 500
    """The reader keeps 10 000 packages for a late recorder."""

    def __init__(self, recorded: RecordedStream, host: str) -> None:
        rows = slice(recorded.rows.start, recorded.rows.stop)
        is_pose = recorded.stream.traits.kind == "pose"
        self._variable = "actual_TCP_pose" if is_pose else "actual_TCP_force"
        self._value = recorded.stream.array("value")[rows].tolist()
        self._device_t = recorded.stream.array("device_t")[rows].tolist()
        self._scaling = (
            recorded.stream.array("speed_scaling")[rows].tolist()
            if is_pose
            else [1.0] * len(self._value)
        )
        self._names: list[str] = []
        self._types: tuple[str, ...] = ()
        self._listener = Listener(host, rtde.PORT, self._greet)

    @property
    def address(self) -> str:
        """Host it listens on."""
        return self._listener.host

    def start(self) -> None:
        """Start listening.

        Raises:
            OSError: The port is not available.
        """
        self._listener.start()

    def send(self, place: int) -> None:
        """Send one data package, as recorded.

        Raises:
            OSError: The client is gone.
        """
        known: dict[str, rtde.Value] = {
            "timestamp": self._device_t[place],
            self._variable: tuple(self._value[place]),
            "speed_scaling": self._scaling[place],
            "target_speed_fraction": 1.0,
            "runtime_state": _PLAYING,
            "safety_status_bits": _NORMAL,
            "robot_mode": _RUNNING,
        }
        values = [
            known.get(name, (0.0,) * 6 if kind == "VECTOR6D" else 0)
            for name, kind in zip(self._names, self._types, strict=True)
        ]
        package = bytes([_RECIPE]) + rtde.pack_values(self._types, values)
        self._listener.send(rtde.pack_message(rtde.Kind.DATA, package))

    def idle(self) -> None:
        """Send a text message."""
        if self._listener.connected:
            self._listener.send(rtde.pack_message(rtde.Kind.TEXT, _WAITING))

    def wake(self) -> None:
        """Do nothing: the reader's waits are short."""

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._listener.close()

    def _greet(self, client: socket.socket) -> bool:
        """Answer requests until the client starts the stream."""
        buffer = bytearray()
        while received := client.recv(1 << 16):
            buffer += received
            for kind, payload in rtde.split_messages(buffer):
                client.sendall(rtde.pack_message(kind, self._answer(kind, payload)))
                if kind == rtde.Kind.START:
                    return True
        return False

    def _answer(self, kind: int, payload: bytes) -> bytes:
        if kind == rtde.Kind.CONTROLLER:
            return b"".join(part.to_bytes(4, "big") for part in VERSION)
        if kind == rtde.Kind.OUTPUTS:
            _, self._names = rtde.unpack_output_request(payload)
            types = [rtde.OUTPUTS.get(name, "NOT_FOUND") for name in self._names]
            self._types = tuple(types)
            return rtde.pack_recipe(_RECIPE, types)
        return b"\x01"
