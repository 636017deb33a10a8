"""Emulated Robotiq 2F gripper: Modbus RTU on a pty.

    python -m rig.mock.emulate robotiq_2f '{"device": {"port": "/tmp/tty"}, "holding": true}'

The port becomes a link to the pty, as udev's links name a lab's port. A pty has no baud rate: any
rate works. Faults are injected through rig.core.fault_injection, with these in addition:

    lose_grip            the object is gone, the fingers close
    slip      counts     the fingers close by this much and still hold
    insert    at         an object is put between the fingers
    fail      code       a fault code until the gripper is reset
"""

import contextlib
import os
import queue
import select
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from rig.core.clock import SECOND_NS, Clock, Pacer
from rig.core.emulation import Pty, PtyEmulator, Served, SharedWorld
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.core.playback import PlayableConfig, Playback
from rig.core.samples import HAND_TRUTH
from rig.core.shared_memory import SharedLatest
from rig.devices.gripper import robotiq_wire as wire
from rig.devices.gripper.settings import HandConfig

# Behaviour of the emulated gripper: activation, movement, the object, faults. No I/O.
#
# Faults are methods, called by the fault port (`benchmarks faults`) or by a test in the process.

# The first open and close takes this long [s].
ACTIVATION = 1.5
# Counts per second at rSP 0 and 255: 20 and 150 mm/s of a 2F-85.
_SLOWEST, _FASTEST = 60.0, 450.0
# Positions at which the fingers come to rest without an object, counts.
_OPEN, _CLOSED = 3, 230
_SILENT_NS = SECOND_NS
# Motor current [A].
_HOLDING_CURRENT, _MOVING_CURRENT = 0.06, 0.2
# Force at rFR 0 and 255 [N], of a 2F-85.
_WEAKEST, _STRONGEST = 20.0, 235.0
# Rate at which a World follows a hand.
_CYCLES_HZ = 250.0


class Hand:
    """Links of a hand's fingers to its World, by records of their opening and of one's state."""

    def __init__(self, device: HandConfig, hand: Path, world: Path | None) -> None:
        self._device, self._world = device, SharedWorld(world)
        self._record = SharedLatest.attach(hand, HAND_TRUTH, writable=True)

    @property
    def force(self) -> float:
        """Force on a finger [N]."""
        return -float(self._world.state()[1]["wrench"][2])

    def tell(self, t_ns: int, position: float) -> None:
        """Tell the World a position in counts."""
        self._record.write((t_ns, self._device.opening(position)))


class Fingers:
    """Model of a 2F gripper, as seen in its registers.

    Closing fingers meet the object at `object_at`, counts, if there is one; `holding` starts
    activated and closed on it. Those of a `hand` are active, and meet what is in its World.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        object_at: int | None = None,
        holding: bool = False,
        hand: Hand | None = None,
    ) -> None:
        self._clock, self.hand = clock, hand
        self._object_at: float | None = object_at
        self._command = wire.GripperCommand(activate=False)
        self._state = wire.RESET
        self._activated_ns = 0
        self._position = float(_OPEN)
        self._moved_ns = self._heard_ns = clock.now_ns()
        self._fault = 0
        if hand is not None:
            self._command, self._state = wire.GripperCommand(position=_OPEN), wire.ACTIVE
        if holding:
            if object_at is None:
                raise ValueError("holding: nothing to hold; allowed: with an object")
            self._command = wire.GripperCommand(go=True, position=255, speed=50, force=150)
            self._state, self._position = wire.ACTIVE, float(object_at)

    def obey(self, command: wire.GripperCommand) -> None:
        """Execute the command that was written to the registers."""
        self.advance()
        if not command.activate:
            self._state, self._fault = wire.RESET, 0
        elif not self._command.activate:
            self._state, self._activated_ns = wire.ACTIVATING, self._clock.now_ns()
        elif command.go and self._state != wire.ACTIVE:
            self._fault = 5
        self._command = command

    def heard(self) -> None:
        """Note that the line is alive; after a second of silence the next status reports it."""
        now_ns = self._clock.now_ns()
        if now_ns - self._heard_ns > _SILENT_NS:
            self._fault = wire.SILENT_FAULT
        self._heard_ns = now_ns

    def status(self) -> wire.GripperStatus:
        """Return the current status; the fault of a silence is reported once."""
        self.advance()
        command, fault = self._command, self._fault
        if fault == wire.SILENT_FAULT:
            self._fault = 0
        detection = self._object()
        current = 0.0
        if self._state == wire.ACTIVE and command.go:
            current = _MOVING_CURRENT if detection == wire.MOVING else _HOLDING_CURRENT
        return wire.GripperStatus(
            active=command.activate,
            going=command.go,
            state=self._state,
            object=detection,
            fault=fault,
            requested=command.position,
            position=round(self._position),
            current=current,
        )

    def lose_grip(self) -> None:
        """Remove the object: the fingers close further and find nothing."""
        self.advance()
        self._object_at = None

    def slip(self, counts: int) -> None:
        """Let the fingers close by `counts` while still holding: the object turned or crept."""
        self.advance()
        if self._object_at is not None:
            self._object_at += counts
            self._position = float(self._object_at)

    def insert(self, at: int) -> None:
        """Put an object between open fingers."""
        self.advance()
        self._object_at = at

    def fail(self, fault: int) -> None:
        """Report this fault code until the gripper is reset."""
        self._fault = fault

    def advance(self) -> None:
        """Move until now, and tell it the World of a hand."""
        self._move()
        if self.hand is not None:
            self.hand.tell(self._moved_ns, self._position)

    def _move(self) -> None:
        now_ns = self._clock.now_ns()
        elapsed, self._moved_ns = (now_ns - self._moved_ns) / SECOND_NS, now_ns
        if self._state == wire.ACTIVATING and now_ns - self._activated_ns >= ACTIVATION * SECOND_NS:
            self._state, self._position = wire.ACTIVE, float(_OPEN)
        if self._state != wire.ACTIVE or not self._command.go:
            return
        goal = self._goal()
        fraction = self._command.speed / 255
        step = elapsed * (_SLOWEST + fraction * (_FASTEST - _SLOWEST))
        if abs(goal - self._position) <= step:
            self._position = goal
        else:
            self._position += step if goal > self._position else -step

    def _goal(self) -> float:
        goal = float(min(max(self._command.position, _OPEN), _CLOSED))
        if self.hand is not None and goal > self._position:
            most = _WEAKEST + self._command.force / 255 * (_STRONGEST - _WEAKEST)
            self._object_at = self._position if self.hand.force >= most else None
        if self._object_at is not None and goal > self._object_at >= self._position:
            return float(self._object_at)
        return goal

    def _object(self) -> int:
        if self._state != wire.ACTIVE or not self._command.go:
            return wire.AT_POSITION if self._state == wire.RESET else wire.MOVING
        goal = self._goal()
        if self._position != goal:
            return wire.MOVING
        return wire.STOPPED_CLOSING if goal == self._object_at else wire.AT_POSITION


# A pause this long ends a frame, as 3.5 characters do on a wire; a pty delivers in chunks [s].
_GAP = 0.02
# Questions of a driver before a playback starts.
_BEFORE = 3


class Tape:
    """Recorded statuses, each for one question; the first is also for those before the start."""

    def __init__(self, playback: Playback, device: HandConfig) -> None:
        self._playback, self._device = playback, device
        self._due: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        for _ in range(_BEFORE):
            self._due.put(0)

    def run(self, ending: threading.Event) -> None:
        """Play the recording."""
        self._playback.run(self._due.put, window=1, ending=ending, wake=lambda: self._due.put(None))

    def next(self, ending: threading.Event) -> wire.GripperStatus | None:
        """Return the next status once it is due; None at the end."""
        while self._due.empty():
            if ending.wait(_GAP / 10):
                return None
        if (place := self._due.get()) is None:
            return None
        stream, row = self._playback.recorded.stream, self._playback.recorded.rows[place]
        now = {name: stream.array(name)[row] for name in stream.names}
        return wire.GripperStatus(
            active=True,
            going=True,
            state=wire.ACTIVE,
            object=int(now["object"]),
            fault=int(now["fault"]),
            requested=self._device.position(now["commanded"]),
            position=self._device.position(now["value"]),
            current=float(now["current"]),
        )


class RobotiqEmulator(PtyEmulator):
    """An emulated gripper, which behaves like `fingers`, on a pty that `link` leads to."""

    def __init__(
        self,
        fingers: Fingers,
        link: Path,
        clock: Clock,
        *,
        slave: int = 9,
        seed: int = 0,
        delay: float = 0.0,
        tape: Tape | None = None,
    ) -> None:
        super().__init__(link)
        self._clock, self._delay, self._tape = clock, delay, tape
        self.fingers = fingers
        self.faults = FaultInjector[bytes](clock, spoil=corrupted_bytes, seed=seed)
        self.requests = 0
        """Number of requests answered so far."""
        self._slave = slave
        self._lock = threading.Lock()

    def inject(self, fault: str, **values: Any) -> dict[str, Any]:
        """Inject a fault and return the emulator's state."""
        own: dict[str, Callable[[], None]] = {
            "lose_grip": self.fingers.lose_grip,
            "slip": lambda: self.fingers.slip(int(values["counts"])),
            "insert": lambda: self.fingers.insert(int(values["at"])),
            "fail": lambda: self.fingers.fail(int(values["code"])),
        }
        if fault in own:
            with self._lock:
                own[fault]()
            line = self.faults.inject("state")
        else:
            line = self.faults.inject(fault, **values)
        return {**line, "requests": self.requests}

    def start(self) -> None:
        """Create the pty, serve, and move with a World or a recording."""
        super().start()
        more = [self._move] if self.fingers.hand else []
        for target in more + ([partial(self._tape.run, self._ending)] if self._tape else []):
            self._threads.append(threading.Thread(target=target))
            self._threads[-1].start()

    def _move(self) -> None:
        pacer = Pacer(self._clock, _CYCLES_HZ)
        while not self._ending.is_set():
            pacer.wait()
            with self._lock:
                self.fingers.advance()

    def _serve(self) -> None:
        pending = b""
        while not self._ending.is_set():
            # Only this thread opens and closes the pty, so that no reused descriptor is read.
            if self.faults.unplugged:
                self._release()
                self._ending.wait(0.01)
                continue
            if self._pty is None:
                self._pty = Pty(self._link)
                pending = b""
            fd = self._pty.fd
            with contextlib.suppress(OSError, ValueError):
                if not select.select([fd], [], [], _GAP)[0]:
                    pending = b""
                    continue
                pending += os.read(fd, 1024)
                pending = self._answers(fd, pending)

    def _answers(self, fd: int, pending: bytes) -> bytes:
        """Answer the complete requests in `pending` and return the rest."""
        while (length := wire.request_length(pending)) is not None and len(pending) >= length:
            frame, pending = pending[:length], pending[length:]
            try:
                request = wire.parse_request(frame)
            except wire.FrameError:
                # Out of sync: no answer, and the rest of the data is not trusted either.
                return b""
            if request.slave != self._slave:
                continue
            with self._lock:
                reply = self._answer(request)
            self.requests += 1
            self._ending.wait(self._delay)
            for message in self.faults.passed(reply):
                os.write(fd, message)
        return pending

    def _answer(self, request: wire.ModbusRequest) -> bytes:
        self.fingers.heard()
        if request.function == wire.WRITE:
            if request.address != wire.COMMAND_ADDRESS:
                return wire.emit_refusal(request, wire.ILLEGAL_ADDRESS)
            if request.count != wire.REGISTERS:
                return wire.emit_refusal(request, wire.ILLEGAL_VALUE)
            self.fingers.obey(wire.parse_command(request.values))
            return wire.emit_reply(request)
        if request.function not in (wire.READ_HOLDING, wire.READ_INPUT):
            return wire.emit_refusal(request, wire.ILLEGAL_FUNCTION)
        first = request.address - wire.STATUS_ADDRESS
        if first < 0 or first + request.count > wire.REGISTERS:
            return wire.emit_refusal(request, wire.ILLEGAL_ADDRESS)
        if request.count < 1:
            return wire.emit_refusal(request, wire.ILLEGAL_VALUE)
        status = self.fingers.status() if self._tape is None else self._tape.next(self._ending)
        if status is None:
            return b"\0"  # wakes a driver that waits
        registers = wire.emit_status(status)
        return wire.emit_reply(request, registers[first : first + request.count])


@dataclass(frozen=True, slots=True)
class RobotiqEmulatorConfig(PlayableConfig):
    """Port and object of the emulated gripper."""

    device: HandConfig
    holding: bool = False
    """Start activated and closed on the object."""
    hand: Path | None = None
    """Record of the opening, for the World of a hand; None: an object at `object_mock`."""
    delay: float = field(default=0.0, metadata={"unit": "ms"})
    """Time until an answer is sent [s]."""


def emulate(settings: RobotiqEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated gripper, with the object at `object_mock` of its device."""
    device, tape = settings.device, None
    if (playback := settings.playback(clock)) is not None:
        made = playback.recorded.stream.attrs["device"]
        device = replace(device, **{key: made[key] for key in ("slave", "per_count", "closed")})
        tape = Tape(playback, device)
    if settings.hand is None:
        fingers = Fingers(clock, object_at=device.object_mock, holding=settings.holding)
    else:
        fingers = Fingers(clock, hand=Hand(device, settings.hand, settings.world))
    port, line = Path(device.port), {"slave": device.slave, "seed": settings.seed}
    emulator = RobotiqEmulator(fingers, port, clock, **line, delay=settings.delay, tape=tape)
    return Served("gripper", emulator, emulator.inject)
