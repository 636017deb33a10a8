"""The connections of an emulated controller: RTDE, script upload, and lines of text.

Nothing blocks: each client keeps what has arrived and what could not be sent yet.
"""

from __future__ import annotations

import logging
import re
import socket
from collections.abc import Callable
from typing import Protocol

from rig.arm import rtde
from rig.arm.controller import VERSION, Controller
from rig.disturbance import Disturbance

logger = logging.getLogger(__name__)

_UNSENT_LIMIT = 1 << 20
"""A client that lets this much pile up is dropped, as the controller does [bytes]."""

_POSES = ("actual_TCP_pose", "target_TCP_pose")
"""Sent in mm and thousandths of a radian by a controller with the wrong units."""

_PROGRAM_END = re.compile(r"^end\s*\n", re.MULTILINE)


class Client(Protocol):
    """What the emulator's loop needs of a connection."""

    peer: socket.socket

    def receive(self) -> bool:
        """Take what has arrived; False when the connection is over."""


def _take(peer: socket.socket) -> bytes | None:
    """What has arrived, empty when nothing has, None when the connection is over."""
    try:
        return peer.recv(1 << 16) or None
    except BlockingIOError:
        return b""
    except OSError:
        return None


class LineClient:
    """A text protocol: each line received is answered by one line.

    Args:
        peer: The connection.
        answer: Answers a line, both without line end.
        banner: Sent on connecting.
    """

    def __init__(self, peer: socket.socket, answer: Callable[[str], str], banner: str = "") -> None:
        self.peer = peer
        self._answer = answer
        self._buffer = b""
        if banner:
            self.peer.send(banner.encode())

    def receive(self) -> bool:
        """Take what has arrived; False when the connection is over."""
        received = _take(self.peer)
        if received is None:
            return False
        *lines, self._buffer = (self._buffer + received).split(b"\n")
        try:
            for line in lines:
                self.peer.send(self._answer(line.decode(errors="replace")).encode() + b"\n")
        except OSError:
            return False
        return True


class ScriptClient:
    """Receives URScript; a program is complete at a line `end` that is not indented.

    Args:
        peer: The connection.
        start: Called with each complete program.
    """

    def __init__(self, peer: socket.socket, start: Callable[[str], None]) -> None:
        self.peer = peer
        self._start = start
        self._text = ""

    def receive(self) -> bool:
        """Take what has arrived; False when the connection is over."""
        received = _take(self.peer)
        if received is None:
            return False
        self._text += received.decode(errors="replace")
        while found := _PROGRAM_END.search(self._text):
            program, self._text = self._text[: found.end()], self._text[found.end() :]
            self._start(program)
        return True


class RtdeClient:
    """One RTDE connection: its recipes, and the inputs it owns.

    Args:
        peer: The connection.
        controller: Where values come from and go to.
        owners: Which client may write an input; shared by all clients of a controller.
        line: What is wrong with the line that its data packages take.
    """

    def __init__(
        self,
        peer: socket.socket,
        controller: Controller,
        owners: dict[str, RtdeClient],
        line: Disturbance[bytes],
    ) -> None:
        self.peer = peer
        self._controller = controller
        self._owners = owners
        self.line = line
        self._poses: list[int] = []
        self._buffer = bytearray()
        self._unsent = b""
        self._started = False
        self._every = 1
        self._output_types: tuple[str, ...] = ()
        self._sources: list[Callable[[], rtde.Value]] = []
        # ur_rtde relies on input recipes being numbered 1, 2, 3... in the order it asks for them.
        self._inputs: list[tuple[list[str], tuple[str, ...]]] = []

    def receive(self) -> bool:
        """Take what has arrived; False when the connection is over."""
        received = _take(self.peer)
        if received is None:
            return False
        self._buffer += received
        try:
            for kind, payload in rtde.split_messages(self._buffer):
                self._handle(kind, payload)
        except (ValueError, IndexError) as error:
            logger.warning("arm emulator: RTDE client dropped: %s", error)
            return False
        return True

    def _handle(self, kind: int, payload: bytes) -> None:
        if kind == rtde.Kind.DATA:
            self._take_inputs(payload)
        elif kind == rtde.Kind.PROTOCOL:
            self._send(kind, bytes([int.from_bytes(payload, "big") == rtde.PROTOCOL]))
        elif kind == rtde.Kind.CONTROLLER:
            self._send(kind, b"".join(part.to_bytes(4, "big") for part in VERSION))
        elif kind == rtde.Kind.OUTPUTS:
            self._send(kind, self._set_outputs(payload))
        elif kind == rtde.Kind.INPUTS:
            self._send(kind, self._add_inputs(payload))
        elif kind in (rtde.Kind.START, rtde.Kind.PAUSE):
            self._started = kind == rtde.Kind.START
            self._send(kind, b"\x01")
        else:
            logger.warning("arm emulator: RTDE message type %d ignored", kind)

    def _set_outputs(self, payload: bytes) -> bytes:
        rate_hz, names = rtde.unpack_output_request(payload)
        types = [rtde.OUTPUTS.get(name, "NOT_FOUND") for name in names]
        known = [name for name in names if name in rtde.OUTPUTS]
        self._every = max(1, round(rtde.CONTROLLER_RATE_HZ / rate_hz))
        self._output_types = tuple(rtde.OUTPUTS[name] for name in known)
        self._poses = [place for place, name in enumerate(known) if name in _POSES]
        self._sources = [self._controller.source(name) for name in known]
        return rtde.pack_recipe(1, types)

    def _add_inputs(self, payload: bytes) -> bytes:
        names = rtde.unpack_names(payload)
        types = [
            rtde.INPUTS.get(name, "NOT_FOUND") if self._owners.get(name, self) is self else "IN_USE"
            for name in names
        ]
        self._inputs.append((names, tuple(types)))
        if {"NOT_FOUND", "IN_USE"} & set(types):
            return rtde.pack_recipe(0, types)
        self._owners.update(dict.fromkeys(names, self))
        return rtde.pack_recipe(len(self._inputs), types)

    def _take_inputs(self, payload: bytes) -> None:
        names, types = self._inputs[payload[0] - 1]
        try:
            self._controller.write_inputs(names, rtde.unpack_values(types, payload[1:]))
        except ValueError as error:
            # The controller ignores such a package; ur_rtde has calls that send one.
            logger.warning("arm emulator: input recipe %d: %s", payload[0], error)

    def publish(self) -> None:
        """Send this cycle's data package if the client's rate says so."""
        if self._started and self._controller.tick % self._every == 0:
            values = [source() for source in self._sources]
            if not self.line.on:
                self._send(rtde.Kind.DATA, b"\x01" + rtde.pack_values(self._output_types, values))
                return
            if self.line.wrong_units:
                for place in self._poses:
                    values[place] = tuple(1e3 * part for part in values[place])  # type: ignore[union-attr]
            payload = b"\x01" + rtde.pack_values(self._output_types, values)
            for sent in self.line.passed(payload):
                self._send(rtde.Kind.DATA, sent)

    def _send(self, kind: int, payload: bytes) -> None:
        self._unsent += rtde.pack_message(kind, payload)
        try:
            sent = self.peer.send(self._unsent)
            self._unsent = self._unsent[sent:]
            if len(self._unsent) > _UNSENT_LIMIT:
                self.peer.shutdown(socket.SHUT_RDWR)
        except BlockingIOError:
            pass
        except OSError:
            # Reading finds the connection closed and takes the client off the list.
            self._started = False
