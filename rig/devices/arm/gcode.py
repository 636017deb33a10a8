"""A stage of three axes with GRBL firmware on a serial port, in place of the arm.

A port has one owner: the process that records the stage's positions. It also passes on the moves of
the process that moves the stage, which is connected to it by a local socket. A move is sent in
pieces of a tenth of a second, a few ahead of the stage: where either process dies or falls silent,
the stage stops by itself.

GRBL takes lines of G-code, answered by `ok` or `error:N` when they are taken, not when they are
done; `?` asks for `<Idle|MPos:x,y,z|...>`, `!` holds the feed and 0x18 clears the rest of the way.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import select
import socket
import struct
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.geometry import Array, rotation_between
from rig.devices.arm.settings import GcodeConfig
from rig.devices.force.serial_driver import SerialDriver

logger = logging.getLogger(__name__)

# `Hold:1` is still slowing down, `Hold:0` at rest.
_REPORT = re.compile(r"<(\w+(?::1)?)(?::\d)?\|([MW])Pos:([-\d.]+),([-\d.]+),([-\d.]+)")
# RTDE's safety status bits of a controller that is well, and in a protective stop.
_NORMAL, _STOPPED = 0x1, 0x404
_POLL = 0.01
# Time that a piece of a move takes, and how far ahead of the stage pieces are sent [s].
_PIECE, _AHEAD = 0.1, 0.2
# Lines that GRBL has not answered yet, at most: they must fit in its buffer of 128 bytes.
_UNANSWERED = 3
# Distance from the goal that counts as there [m], and the time for it once the stage is idle [s].
_THERE, _IDLE = 2e-5, 0.3
# Time after which the version is asked for again [s].
_ASKED = 0.5
# Without a report for this long the stage is lost [s].
_SILENCE = 1.0
# Largest angle of a pose from that of the tip [rad].
_TURNED = 2e-3
_CAPACITY = 10_000


def _socket_name(port: str) -> str:
    return f"\0tactile-rig {os.path.realpath(port)}"


@dataclass(slots=True)
class _Way:
    """A move that is being sent."""

    start: Array
    goal: Array
    speed: float
    acceleration: float
    sent: float = 0.0
    """Length that was sent [m]."""
    idle_ns: int = 0
    """Time since which the stage is idle after all was sent; 0: it is not."""


class StageDriver(SerialDriver):
    """Stream of a stage's poses, with the columns of `RtdeLink`; moves it for a `StageClient`.

    Args:
        config: Port and limits of motion.
        clock: Timestamps the reports.
    """

    POWER: ClassVar[str] = "the power of the stage's board"

    def __init__(self, config: GcodeConfig, clock: Clock) -> None:
        super().__init__(config.port, clock, _CAPACITY)
        self._config = config
        self._buffer = b""
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._orders = b""
        self._state = self._version = ""

    def open(self, timeout: float) -> None:
        """Open the port and wait for the first position and the firmware's version.

        Raises:
            DeviceLost: No such port, no GRBL answers within `timeout` [s], or it is in alarm.
            ConfigError: It reports positions of the work, not of the machine.
        """
        self._reset()
        self._buffer, self._unanswered, self._operation = b"", 0, 0
        self._way: _Way | None = None
        self._stopping = False
        self._sample: dict[str, Any] | None = None
        self._state = self._version = ""
        self._due_ns = self._kicked_ns = asked_ns = 0
        self._heard_ns = self._clock.now_ns()
        deadline_ns = self._heard_ns + round(timeout * SECOND_NS)
        try:
            with self._errors():
                self._connect(self._config.baud, timeout=0, write_timeout=1.0).reset_input_buffer()
            # A stage that was left in a hold is cleared first; GRBL takes `$I` only when idle.
            while self._state != "Alarm" and not (self._state == "Idle" and self._version):
                now_ns = self._heard_ns = self._clock.now_ns()
                if now_ns > deadline_ns:
                    raise DeviceLost(self._unready(timeout))
                if self._state == "Idle" and now_ns - asked_ns > _ASKED * SECOND_NS:
                    self._write(b"\n$I\n")
                    asked_ns = now_ns
                self._receive()
            if self._state == "Alarm":
                raise DeviceLost(
                    f"{self._where}: the stage is not homed, or at a limit switch; home it with "
                    "its own program ($H)"
                )
            self._write(b"G21 G90 G94\n")
            self._unanswered = 0
            self._listener = self._listening()
        except BaseException:
            self.close()
            raise
        self._start_receiving(f"stage-{self._where}")

    def _unready(self, timeout: float) -> str:
        """Return the message about a stage that did not become ready within `timeout` [s]."""
        if self._sample is None:
            return (
                f"{self._where}: no position from a board with GRBL within {timeout:g} s; "
                f"check its power, and its baud rate against {self._config.baud}"
            )
        if self._state != "Idle":
            return f"{self._where}: the stage is still in state {self._state} after {timeout:g} s"
        return (
            f"{self._where}: positions, but no version ([VER:...] in answer to $I) within "
            f"{timeout:g} s; allowed: a board with GRBL 1.1 or newer"
        )

    def _listening(self) -> socket.socket:
        listener = socket.socket(socket.AF_UNIX)
        try:
            listener.bind(_socket_name(self._where))
            listener.listen(1)
        except OSError as error:
            listener.close()
            raise DeviceLost(f"{self._where}: is moved by another collection ({error})") from error
        return listener

    def describe(self) -> dict[str, Any]:
        """Return the properties that the board gave on opening."""
        return {
            "model": "stage, GRBL",
            "address": self._where,
            "controller_version": self._version,
            "rate_hz": self._config.rate_hz,
            "device_clock": "none",
        }

    def _release(self) -> None:
        for each in (self._client, self._listener):
            if each is not None:
                each.close()
        self._client = self._listener = None
        if self._port is not None and self._way is not None:
            with contextlib.suppress(DeviceLost):
                self._write(b"!")
        super()._release()

    def _write(self, content: bytes) -> None:
        with self._errors():
            self._open_port().write(content)

    def _receive(self) -> None:
        """Handle the data that arrives within a fraction of a second, and go on with a move.

        Raises:
            DeviceLost: The port is gone, or silent.
        """
        port = self._open_port()
        sources: list[Any] = [port, *(each for each in (self._listener, self._client) if each)]
        with self._errors():
            wait = (self._due_ns - self._clock.now_ns()) / SECOND_NS
            ready = select.select(sources, [], [], min(max(wait, 0.0), _POLL))[0]
            if port in ready:
                self._buffer += port.read(port.in_waiting or 1)
        *lines, self._buffer = self._buffer.split(b"\n")
        for line in lines:
            self._take(line.decode(errors="replace").strip())
        if self._listener in ready and self._listener is not None:
            self._accept(self._listener)
        if self._client in ready and self._client is not None:
            self._obey(self._client)
        now_ns = self._clock.now_ns()
        if now_ns - self._heard_ns > _SILENCE * SECOND_NS:
            raise DeviceLost(f"{self._where}: no position for {_SILENCE:g} s; {self.POWER}?")
        if now_ns >= self._due_ns:
            period_ns = round(SECOND_NS / self._config.rate_hz)
            self._due_ns = max(self._due_ns + period_ns, now_ns - period_ns)
            self._write(b"?")
        if self._way is not None:
            self._go_on(self._way, now_ns)

    def _take(self, line: str) -> None:
        if line == "ok":
            self._unanswered = max(self._unanswered - 1, 0)
        elif line.startswith("[VER:"):
            self._version = line[5:].rstrip(":]")
        elif line.startswith(("error:", "ALARM:")):
            logger.warning("%s: %s", self._where, line)
            self._unanswered = max(self._unanswered - 1, 0)
            if self._way is not None:
                self._stop()
        elif report := _REPORT.match(line):
            self._report(report)

    def _report(self, report: re.Match[str]) -> None:
        if report[2] == "W":
            raise ConfigError(f"{self._where}: reports WPos; allowed: MPos (send $10=1 to it)")
        t_ns = self._clock.now_ns()
        self._state, self._heard_ns = report[1], t_ns
        place = 1e-3 * np.array([float(report[k]) for k in (3, 4, 5)])
        before, speed = self._sample, np.zeros(3)
        if before is not None and self._state != "Idle":
            speed = (place - before["value"][:3]) / max((t_ns - before["t_ns"]) / SECOND_NS, 1e-3)
        self._sample = {
            "t_ns": t_ns,
            "device_t": float("nan"),
            "value": np.array([*place, *self._config.rotation]),
            "speed": np.array([*speed, 0.0, 0.0, 0.0]),
            "speed_scaling": 1.0,
            "speed_fraction": 1.0,
            "runtime_state": 2,
            "safety_status": _STOPPED if self._state in ("Alarm", "Door") else _NORMAL,
            "robot_mode": 7,
        }
        if self._state == "Hold":
            # At rest: the rest of the way is cleared, which in motion would lose the position.
            self._write(b"\x18")
        elif self._stopping and self._state in ("Idle", "Alarm"):
            self._stopping = False
            self._unanswered = 0
        self._tell()
        self._inbox.put(dict(self._sample), t_ns)

    # Moves

    def _accept(self, listener: socket.socket) -> None:
        client, _ = listener.accept()
        _, user, _ = struct.unpack(
            "3i", client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        )
        if self._client is not None or user != os.getuid():
            client.close()
            return
        client.setblocking(False)
        self._client, self._orders = client, b""
        self._kicked_ns = self._clock.now_ns()

    def _obey(self, client: socket.socket) -> None:
        try:
            received = client.recv(1 << 16)
        except OSError:
            received = b""
        if not received:
            client.close()
            self._client = None
            if self._way is not None:
                self._stop()
            return
        self._kicked_ns = self._clock.now_ns()
        *lines, self._orders = (self._orders + received).split(b"\n")
        for line in lines:
            order = json.loads(line)
            if "goal" in order and self._sample is not None:
                start = self._sample["value"][:3].copy()
                goal = np.array(order["goal"])
                self._way = _Way(start, goal, order["speed"], order["acceleration"])
                self._operation += 1
            elif "stop" in order:
                self._operation += 1
                self._stop()

    def _stop(self) -> None:
        self._way = None
        self._stopping = True
        self._write(b"!")

    def _go_on(self, way: _Way, now_ns: int) -> None:
        """Send the next pieces of a move, or end it."""
        if now_ns - self._kicked_ns > SECOND_NS / self._config.watchdog_hz:
            logger.warning("%s: no command for too long: the stage stops", self._where)
            self._stop()
            return
        if self._sample is None or self._stopping:
            return
        length = float(np.linalg.norm(way.goal - way.start))
        place = self._sample["value"][:3]
        done = float((place - way.start) @ (way.goal - way.start)) / max(length, 1e-9)
        ahead = way.speed * _AHEAD + way.speed**2 / (2 * way.acceleration)
        while way.sent < length and way.sent - done < ahead and self._unanswered < _UNANSWERED:
            way.sent = min(way.sent + max(way.speed * _PIECE, 2 * _THERE), length)
            x, y, z = 1e3 * (way.start + (way.goal - way.start) * (way.sent / length))
            feed = 6e4 * way.speed
            self._write(f"G1 X{x:.4f} Y{y:.4f} Z{z:.4f} F{feed:.2f}\n".encode())
            self._unanswered += 1
        if way.sent < length or self._state != "Idle":
            way.idle_ns = 0
            return
        way.idle_ns = way.idle_ns or now_ns
        there = float(np.linalg.norm(place - way.goal)) <= _THERE
        if there or now_ns - way.idle_ns > _IDLE * SECOND_NS:
            self._way = None

    def _tell(self) -> None:
        if self._client is None or self._sample is None:
            return
        running = self._way is not None or self._stopping
        told = {**self._sample, "operation": self._operation % 128, "running": running}
        line = json.dumps({key: np.asarray(value).tolist() for key, value in told.items()})
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            self._client.send(line.encode() + b"\n")


class StageClient:
    """Pose link and control of a stage, by the process that records its poses.

    It has the methods of `RtdeLink` and `UrControl`.

    Args:
        config: Port and orientation.
        clock: Not needed: samples have the times of the recording process.
    """

    def __init__(self, config: GcodeConfig, clock: Clock) -> None:
        self._config = config
        self._where = f"stage at {config.port}"
        self._socket: socket.socket | None = None
        self._buffer = b""
        self._newest: tuple[int, bool] = (0, False)

    def open(self, timeout: float) -> None:
        """Connect within `timeout` [s].

        Raises:
            DeviceLost: No process records this stage's poses.
        """
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(timeout)
        try:
            self._socket.connect(_socket_name(self._config.port))
        except OSError as error:
            self.close()
            raise DeviceLost(f"{self._where}: nothing records its poses ({error})") from error

    def receive(self, timeout: float) -> list[dict[str, Any]]:
        """Return every sample that has arrived, waiting up to `timeout` [s] for one.

        Raises:
            DeviceLost: The recording process is gone.
        """
        connection = self._connection()
        if not select.select([connection], [], [], max(timeout, 0.0))[0]:
            return []
        try:
            received = connection.recv(1 << 16)
        except OSError:
            received = b""
        if not received:
            self.close()
            raise DeviceLost(f"{self._where}: the process that owns its port is gone")
        *lines, self._buffer = (self._buffer + received).split(b"\n")
        samples = [json.loads(line) for line in lines]
        if samples:
            self._newest = (samples[-1]["operation"], samples[-1]["running"])
        return samples

    def _connection(self) -> socket.socket:
        if self._socket is None:
            raise DeviceLost(f"{self._where}: not connected")
        return self._socket

    def _send(self, **order: Any) -> bool:
        try:
            self._connection().sendall(json.dumps(order).encode() + b"\n")
        except OSError:
            return False
        return True

    def kick(self) -> bool:
        """Kick the watchdog; return False without a connection."""
        return self._send(kick=1)

    def reaches(self, pose: list[float]) -> bool:
        """Return True if the pose (6,) has the orientation of the tip, which never turns."""
        turned = rotation_between([0.0, 0.0, 0.0, *self._config.rotation], pose)
        return float(np.linalg.norm(turned)) <= _TURNED

    def start_move(self, pose: list[float], speed: float, acceleration: float) -> bool:
        """Start a straight move to TCP pose (6,) [m, rad, m/s, m/s^2]; return False if rejected."""
        return self._send(goal=pose[:3], speed=speed, acceleration=acceleration)

    def start_stop(self, deceleration: float) -> None:
        """Start to stop, with the firmware's own deceleration."""
        self._send(stop=1)

    def operation(self) -> tuple[int, bool]:
        """Return the number of the newest operation (7 bits), and True if it runs."""
        return self._newest

    def connected(self) -> bool:
        """Return True if the process that owns the port is there."""
        return self._socket is not None

    def close(self) -> None:
        """End the connection; a moving stage stops."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
