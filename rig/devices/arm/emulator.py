"""Emulated UR5e controller on a loopback address, for the unmodified ur_rtde and our pose reader.

    python -m rig.mock.emulate ur '{"host": "127.0.0.5", "state": "run/arm", "world": "run/world"}'

Listens on the controller's own ports (RTDE 30004, scripts 30001 to 30003, dashboard 29999).
ur_rtde's constructors hold the GIL while they wait for an answer, so do not run this in the process
of a client that uses ur_rtde.

Of a recording it only reports: no script runs, nothing moves, and quantities that a session does
not store are those of normal operation. While no row is due it sends text messages, as a controller
may: a reader that receives nothing for a second fails.

Faults are injected through rig.core.fault_injection, with these in addition:

    protective_stop, emergency_stop, stop_program
    reset_safety         release at the pendant, as a person does afterwards
    drop                 close every RTDE connection
    freeze  seconds      suspend RTDE for so long, both ways; the arm keeps moving
    slider  fraction     speed slider
    remote_control  on   false: the pendant is in local control
    version  parts       of PolyScope, four numbers
    tool  mass           true mass on the flange [kg], whichever payload is set
    freedrive  pose      a person leads the TCP to this pose [m, rad]
"""

from __future__ import annotations

import contextlib
import logging
import re
import selectors
import socket
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.clock import SECOND_NS, Clock
from rig.core.emulation import Emulator, Served, SharedWorld
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.core.geometry import compose
from rig.core.mock_names import PORTS
from rig.core.playback import PlayableConfig, Playback
from rig.core.samples import ARM_TRUTH
from rig.core.shared_memory import SharedLatest
from rig.devices.arm import dashboard, rtde
from rig.devices.arm.emulated_arm import CYCLE, POSTURE, PoseError, Wrist, flange_pose
from rig.devices.arm.emulated_controller import Controller, dashboard_answer
from rig.devices.arm.settings import ArmConfig

logger = logging.getLogger(__name__)

# Connections of an emulated controller: RTDE, script upload, and lines of text.
#
# Nothing blocks: each client buffers the data received and the data not sent yet.

# A client with this much unsent data is dropped, as the controller does [bytes].
_UNSENT_LIMIT = 1 << 20

# Rows of a recording under way; the reader keeps 10 000 packages for a late recorder.
_WINDOW = 500
_TEXT, _SOURCE, _INFO = b"replay: no row is due", b"tactile-rig", 3
_WAITING = bytes([len(_TEXT)]) + _TEXT + bytes([len(_SOURCE)]) + _SOURCE + bytes([_INFO])

# Sent in mm and thousandths of a radian by the fault `wrong_units`.
_POSES = ("actual_TCP_pose", "target_TCP_pose")

_PROGRAM_END = re.compile(r"^end\s*\n", re.MULTILINE)


class Client:
    """One connection."""

    def __init__(self, peer: socket.socket) -> None:
        self.peer = peer

    def receive(self) -> bool:
        """Process the received data; return False when the connection is over."""
        try:
            received = self.peer.recv(1 << 16)
            if received:
                self._take(received)
        except BlockingIOError:
            return True
        except OSError:
            return False
        except (ValueError, IndexError) as error:
            logger.warning("arm emulator: client dropped: %s", error)
            return False
        return bool(received)

    def _take(self, received: bytes) -> None:
        """Process data; raises ValueError or IndexError if they are not of the protocol."""
        raise NotImplementedError


class DashboardClient(Client):
    """Connection of the dashboard: each line received is answered by one line."""

    def __init__(self, peer: socket.socket, controller: Controller) -> None:
        super().__init__(peer)
        self._controller = controller
        self._buffer = b""
        # The banner must come at once: ur_rtde waits 2 s for it, then fails.
        self.peer.send(dashboard.BANNER.encode())

    def _take(self, received: bytes) -> None:
        *lines, self._buffer = (self._buffer + received).split(b"\n")
        for line in lines:
            answer = dashboard_answer(self._controller, line.decode(errors="replace"))
            self.peer.send(answer.encode() + b"\n")


class ScriptClient(Client):
    """Connection that receives URScript; an unindented line `end` completes a program."""

    def __init__(self, peer: socket.socket, controller: Controller) -> None:
        super().__init__(peer)
        self._controller = controller
        self._text = ""

    def _take(self, received: bytes) -> None:
        self._text += received.decode(errors="replace")
        while match := _PROGRAM_END.search(self._text):
            program, self._text = self._text[: match.end()], self._text[match.end() :]
            self._controller.start_program(program)


class RtdeClient(Client):
    """One RTDE connection: its recipes, and the inputs it owns (`owners` is common to all)."""

    def __init__(
        self,
        peer: socket.socket,
        controller: Controller,
        owners: dict[str, RtdeClient],
        line: FaultInjector[bytes],
    ) -> None:
        super().__init__(peer)
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
        # ur_rtde relies on input recipes being numbered 1, 2, 3... in the order of its requests.
        self._inputs: list[tuple[list[str], tuple[str, ...]]] = []

    def _take(self, received: bytes) -> None:
        self._buffer += received
        for kind, payload in rtde.split_messages(self._buffer):
            self._handle(kind, payload)

    def _handle(self, kind: int, payload: bytes) -> None:
        if kind == rtde.Kind.DATA:
            self._take_inputs(payload)
        elif kind == rtde.Kind.PROTOCOL:
            self._send(kind, bytes([int.from_bytes(payload, "big") == rtde.PROTOCOL]))
        elif kind == rtde.Kind.CONTROLLER:
            parts = [part.to_bytes(4, "big") for part in self._controller.version]
            self._send(kind, b"".join(parts))
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
        available = [name for name in names if name in rtde.OUTPUTS]
        self._every = max(1, round(rtde.CONTROLLER_RATE_HZ / rate_hz))
        self._output_types = tuple(rtde.OUTPUTS[name] for name in available)
        self._poses = [index for index, name in enumerate(available) if name in _POSES]
        self._sources = [self._controller.source(name) for name in available]
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
        """Send a data package if one is due in this cycle at the client's rate."""
        if self._started and self._controller.tick % self._every == 0:
            values = [source() for source in self._sources]
            if not self.line.on:
                self._send(rtde.Kind.DATA, b"\x01" + rtde.pack_values(self._output_types, values))
                return
            if self.line.wrong_units:
                for index in self._poses:
                    values[index] = tuple(1e3 * part for part in values[index])  # type: ignore[union-attr]
            payload = b"\x01" + rtde.pack_values(self._output_types, values)
            for sent in self.line.passed(payload):
                self._send(rtde.Kind.DATA, sent)

    def say_waiting(self) -> None:
        """Send a text message if the client has started its stream."""
        if self._started:
            self._send(rtde.Kind.TEXT, _WAITING)

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
            # Reading will find the connection closed and remove the client.
            self._started = False


SCRIPT_PORTS = (30001, 30002, 30003)
_CYCLE_NS = round(CYCLE * SECOND_NS)
# Host delays of up to 150 ms are caught up, as packages of a real controller would arrive together.
# For longer ones the emulated controller's clock stands still, which is counted in `missed`.
_LATE_CYCLES = 75


class ArmEmulator(Emulator):
    """Serves a `Controller` at 500 Hz against absolute deadlines, on a background thread.

    `missed` counts cycles of host time for which the emulated controller's clock stood still.
    `state` is the ARM_TRUTH record of each cycle's pose, `world` has the contact force. A playback
    has recorded poses, or wrenches of an arm, which are reported in place of the controller's own.
    """

    def __init__(
        self,
        host: str,
        controller: Controller,
        clock: Clock,
        *,
        state: SharedLatest | None = None,
        world: SharedWorld | None = None,
        playback: Playback | None = None,
    ) -> None:
        super().__init__()
        self._host = host
        self._controller = controller
        self._clock = clock
        self._state = state
        self._world = world
        self._playback = playback
        self._world_count = 0
        # Held while the loop works on controller and clients, and while a fault is injected.
        self._lock = threading.Lock()
        self._clients: list[RtdeClient] = []
        self._peers: set[socket.socket] = set()
        self._owners: dict[str, RtdeClient] = {}
        # select(2) waits to the microsecond; epoll, in Python, rounds up to the millisecond.
        self._selector = selectors.SelectSelector()
        self._frozen_until_ns = 0
        # For the plug and for future clients; each client's packages have their own injector.
        self._line = FaultInjector[bytes](clock, spoil=corrupted_bytes, on_change=self._on_plug)

    @property
    def address(self) -> str:
        """Host it listens on."""
        return self._host

    def start(self) -> None:
        """Listen on all ports and run; return when clients can connect."""
        try:
            self._listen(rtde.PORT, self._new_rtde)
            self._listen(dashboard.PORT, lambda peer: DashboardClient(peer, self._controller))
            for port in SCRIPT_PORTS:
                self._listen(port, lambda peer: ScriptClient(peer, self._controller))
        except OSError:
            self._release()
            raise
        run = self._run if self._playback is None else partial(self._play, self._playback)
        self._run_threads(run)

    def _release(self) -> None:
        for key in list((self._selector.get_map() or {}).values()):
            key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()

    def _listen(self, port: int, make: Callable[[socket.socket], Client]) -> None:
        server = socket.socket()
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._selector.register(server, selectors.EVENT_READ, lambda: self._accept(server, make))
        server.setblocking(False)
        server.bind((self._host, port))
        server.listen(8)

    def _accept(self, server: socket.socket, make: Callable[[socket.socket], Client]) -> None:
        try:
            peer, _ = server.accept()
        except OSError:
            return
        if self._line.unplugged:
            peer.close()
            return
        peer.setblocking(False)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = make(peer)
        self._peers.add(peer)
        self._selector.register(peer, selectors.EVENT_READ, lambda: self._serve(peer, client))

    def _serve(self, peer: socket.socket, client: Client) -> None:
        if client.receive():
            return
        self._selector.unregister(peer)
        self._peers.discard(peer)
        peer.close()
        if isinstance(client, RtdeClient):
            self._clients.remove(client)
            self._owners = {k: owner for k, owner in self._owners.items() if owner is not client}

    def _new_rtde(self, peer: socket.socket) -> Client:
        line = FaultInjector[bytes](self._clock, spoil=corrupted_bytes)
        client = RtdeClient(peer, self._controller, self._owners, line)
        self._clients.append(client)
        return client

    def apply(self, fault: str, **values: Any) -> dict[str, Any]:
        """Inject a fault, see the module, and return the state of the controller."""
        with self._lock:
            line = self._injected(fault, values)
            controller, robot = self._controller, self._controller.robot
            return {
                "tick": controller.tick,
                "pose": robot.pose.tolist(),
                "speed": robot.speed.tolist(),
                "tcp": robot.tcp.tolist(),
                "payload": controller.payload,
                "runtime_state": controller.runtime_state,
                "safety_status": controller.safety_status,
                "reason": controller.reason,
                "uploads": controller.uploads,
                **line,
            }

    def _injected(self, fault: str, values: dict[str, Any]) -> dict[str, Any]:
        """Inject a fault; return the state of the connections if it is theirs."""
        controller = self._controller
        match fault:
            case "protective_stop":
                controller.protective_stop("injected")
            case "emergency_stop":
                controller.emergency_stop()
            case "stop_program":
                controller.stop_program("injected")
            case "reset_safety":
                controller.reset_safety()
            case "drop":
                _shut(client.peer for client in self._clients)
            case "freeze":
                seconds = float(values["seconds"])
                self._frozen_until_ns = self._clock.now_ns() + round(seconds * SECOND_NS)
            case "slider":
                controller.robot.slider = float(values["fraction"])
            case "remote_control":
                controller.remote_control = bool(values["on"])
            case "version":
                major, minor, bugfix, build = map(int, values["parts"])
                controller.version = (major, minor, bugfix, build)
            case "tool":
                controller.tool_mass = float(values["mass"])
            case "freedrive":
                controller.lead(np.array(values["pose"], np.float64))
            case _:
                line = self._line.inject(fault, **values)
                for client in self._clients:
                    client.line.inject(fault, **values)
                return line | {"touched": sum(client.line.touched for client in self._clients)}
        return {}

    def _on_plug(self) -> None:
        if self._line.unplugged:
            _shut(self._peers)

    def _run(self) -> None:
        due_ns = self._clock.now_ns() + _CYCLE_NS
        while not self._ending.is_set():
            wait = (due_ns - self._clock.now_ns()) / SECOND_NS
            ready = self._selector.select(max(wait, 0.0))
            with self._lock:
                for key, _ in ready:
                    frozen = self._clock.now_ns() < self._frozen_until_ns
                    if not (frozen and self._is_rtde(key.fileobj)):
                        key.data()
                now_ns = self._clock.now_ns()
                if now_ns < due_ns:
                    continue
                self._cycle(due_ns, now_ns)
            due_ns += _CYCLE_NS
            late = (now_ns - due_ns) // _CYCLE_NS
            if late > _LATE_CYCLES:
                self.missed += late
                due_ns += late * _CYCLE_NS

    def _play(self, playback: Playback) -> None:
        stream, rows = playback.recorded.stream, playback.recorded.rows
        part = slice(rows.start, rows.stop)
        is_pose = stream.traits.kind == "pose"
        value = "actual_TCP_pose" if is_pose else "actual_TCP_force"
        scaling = stream.array("speed_scaling")[part] if is_pose else np.ones(len(rows))
        recorded: list[dict[str, rtde.Value]] = [
            {"timestamp": device_t, value: tuple(numbers), "speed_scaling": fraction}
            for device_t, numbers, fraction in zip(
                stream.array("device_t")[part].tolist(),
                stream.array("value")[part].tolist(),
                scaling.tolist(),
                strict=True,
            )
        ]
        outputs = dict(recorded[0]) if recorded else {}
        self._controller.report(outputs)

        def send(place: int) -> None:
            outputs.update(recorded[place])
            with self._lock:
                for client in self._clients:
                    client.publish()

        def idle() -> None:
            with self._lock:
                for key, _ in self._selector.select(0):
                    key.data()
                for client in self._clients:
                    client.say_waiting()

        playback.run(send, window=_WINDOW, ending=self._ending, idle=idle)

    def _is_rtde(self, fileobj: Any) -> bool:
        return any(client.peer is fileobj for client in self._clients)

    def _cycle(self, due_ns: int, now_ns: int) -> None:
        controller = self._controller
        # The World answers at a few hundred Hz at most: reading it every fifth cycle is enough.
        if self._world is not None and controller.tick % 5 == 0:
            count, state = self._world.state()
            if count != self._world_count:
                self._world_count = count
                controller.wrench = np.array(state["wrench"])
        controller.cycle()
        if self._state is not None:
            self._state.write((due_ns, controller.robot.pose, controller.robot.speed))
        if now_ns >= self._frozen_until_ns:
            for client in self._clients:
                client.publish()


def _shut(peers: Iterable[socket.socket]) -> None:
    for peer in peers:
        # A client may be gone already.
        with contextlib.suppress(OSError):
            peer.shutdown(socket.SHUT_RDWR)


Vector = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class ArmEmulatorConfig(PlayableConfig):
    """Tool and start of the emulated arm."""

    device: ArmConfig = field(default=ArmConfig(host="127.0.0.1"))
    """Its TCP and payload are those of the installation at start."""
    state: Path | None = None
    """File to publish the pose in."""
    pose: Vector | None = None
    """TCP at start, in the base frame: x y z [m] rx ry rz [rad]; None: tool down."""
    fault_port: int | None = field(default=PORTS["arm"], kw_only=True)
    """Port for injecting faults; None: none."""
    wrist: bool = False
    """Report the force as a real arm estimates it, with the errors of a `Wrist` of this `seed`."""
    pose_jitter_mm: float = 0.0
    """Standard deviation of the reported position along each axis [mm]."""
    flipped_rotation: bool = False
    """Report every other tenth of a second the opposite rotation vector of the same rotation."""


def emulate(settings: ArmEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated arm."""
    tcp = np.array(settings.device.tcp)
    pose = settings.pose or compose(flange_pose(np.array(POSTURE)), tcp)
    controller = Controller(np.array(pose), tcp)
    controller.payload = settings.device.payload
    controller.payload_cog = settings.device.payload_cog
    if settings.wrist:
        controller.wrist = Wrist(settings.seed)
    if settings.pose_jitter_mm or settings.flipped_rotation:
        jitter = 1e-3 * settings.pose_jitter_mm
        controller.pose_error = PoseError(jitter, settings.flipped_rotation, settings.seed)
    state = SharedLatest.publish(settings.state, ARM_TRUTH) if settings.state else None
    world = SharedWorld(settings.world)
    playback = settings.playback(clock)
    emulator = ArmEmulator(
        settings.host, controller, clock, state=state, world=world, playback=playback
    )
    return Served("arm", emulator, emulator.apply, settings.priority)
