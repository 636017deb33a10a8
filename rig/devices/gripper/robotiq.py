"""Driver of a Robotiq 2F gripper: Modbus RTU over a serial port, 115200 8N1.

Frames and registers are defined in rig.devices.gripper.robotiq_wire. One request is processed at a
time; several threads may send requests.
"""

import errno
import logging
import select
import termios
import threading
from collections.abc import Callable
from typing import Any, Self

import serial

from rig.core.clock import SECOND_NS, Clock, Pacer
from rig.core.driver import ReceivingDriver
from rig.core.errors import DeviceLost
from rig.devices.gripper import robotiq_wire as wire
from rig.devices.gripper.settings import HandConfig, RobotiqConfig

logger = logging.getLogger(__name__)

# Length of the shortest reply [bytes].
_REFUSAL = 5
# Interval between two checks of a moving gripper: 50 a second.
_LOOK_NS = 20_000_000


class RobotiqDriver:
    """One gripper, as a context manager."""

    def __init__(self, config: RobotiqConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._lock = threading.Lock()
        self._serial: serial.Serial | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self, timeout: float) -> None:
        """Open the port and wait at most `timeout` [s] for a gripper's answer; nothing moves."""
        self.close()
        config = self._config
        try:
            self._serial = serial.Serial(
                config.port,
                config.baud,
                timeout=config.answer,
                write_timeout=config.answer,
                exclusive=True,
            )
        except (OSError, termios.error, ValueError) as error:
            raise DeviceLost(f"{self._where}: {error}{_hint(error)}") from error
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        try:
            # The first answer after a silence still reports the silence (fault 9): ask twice.
            self._answered(deadline_ns)
            self._answered(deadline_ns)
        except DeviceLost:
            self.close()
            raise

    def status(self) -> wire.GripperStatus:
        """Return the gripper's current status."""
        return wire.parse_status(self._ask(wire.READ_INPUT, wire.STATUS_ADDRESS))

    def activate(self, timeout: float) -> wire.GripperStatus:
        """Activate an inactive gripper: in 1 to 2 s it opens, closes and drops its object."""
        if self.status().state == wire.ACTIVE:
            return self.status()
        self.tell(wire.GripperCommand(activate=False))
        self._wait(lambda status: status.state == wire.RESET, timeout, "reset")
        self.tell(wire.GripperCommand(activate=True))
        return self._wait(lambda status: status.state == wire.ACTIVE, timeout, "be active")

    def move(
        self, position: int, *, speed: int, force: int, timeout: float = 10.0
    ) -> wire.GripperStatus:
        """Move the fingers to `position` and wait [s] until they rest there, or on an object.

        Position is 0 open to 255 closed, speed 0 slowest, force 0 weakest, to 255.
        """
        command = wire.GripperCommand(go=True, position=position, speed=speed, force=force)
        if self.status().state != wire.ACTIVE:
            raise DeviceLost(f"{self._where}: not active; activate it first")
        self.tell(command)
        return self._wait(
            lambda status: (
                status.requested == position and status.going and status.object != wire.MOVING
            ),
            timeout,
            "come to rest",
        )

    def close_fingers(self) -> wire.GripperStatus:
        """Close with the configured speed and force; the status shows if it holds an object."""
        return self.move(255, speed=self._config.speed, force=self._config.force)

    def open_fingers(self) -> wire.GripperStatus:
        """Open with the configured speed and force."""
        return self.move(0, speed=self._config.speed, force=self._config.force)

    def describe(self) -> dict[str, Any]:
        """Return properties for the session."""
        status = self.status()
        return {
            "kind": self._config.KIND,
            "slave": self._config.slave,
            "position": status.position,
            "object": status.object,
            "current_a": status.current,
            "status": status.text,
        }

    def close(self) -> None:
        """Close the port; the gripper keeps holding. May be called twice."""
        with self._lock:
            if self._serial is not None:
                try:
                    self._serial.close()
                except (OSError, termios.error) as error:
                    logger.debug("%s: closed with %s", self._where, error)
                self._serial = None

    @property
    def _where(self) -> str:
        return f"gripper at {self._config.port}"

    def _answered(self, deadline_ns: int) -> None:
        while True:
            try:
                self.status()
                return
            except DeviceLost:
                if self._clock.now_ns() > deadline_ns:
                    raise

    def tell(self, command: wire.GripperCommand) -> None:
        """Send a command; the gripper moves meanwhile."""
        self._ask(wire.WRITE, wire.COMMAND_ADDRESS, wire.emit_command(command))

    def _wait(self, reached: Any, timeout: float, what: str) -> wire.GripperStatus:
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while True:
            status = self.status()
            if reached(status):
                return status
            if status.fault >= 8:
                raise DeviceLost(
                    f"{self._where}: fault {status.fault}: {wire.fault_text(status.fault)}"
                )
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"{self._where}: did not {what} in {timeout:g} s: {status.text}")
            self._clock.sleep_until(self._clock.now_ns() + _LOOK_NS)

    def _ask(self, function: int, address: int, values: tuple[int, ...] = ()) -> tuple[int, ...]:
        """Send one request and return the registers of its reply."""
        request = wire.ModbusRequest(self._config.slave, function, address, wire.REGISTERS, values)
        with self._lock:
            port = self._serial
            if port is None:
                raise DeviceLost(f"{self._where}: not open")
            try:
                # The rest of a late answer must not be taken for this one.
                port.reset_input_buffer()
                port.write(wire.emit_request(request))
                frame = self._reply(port, request)
            except (OSError, termios.error, TypeError) as error:
                # pyserial raises TypeError when the port is closed under a read.
                raise DeviceLost(f"{self._where}: {error}; is its cable in?") from error
        if not frame:
            raise DeviceLost(
                f"{self._where}: no answer in {1e3 * self._config.answer:.0f} ms; is it powered, "
                f"and its address {self._config.slave}?"
            )
        try:
            return wire.parse_reply(frame, request)
        except (wire.FrameError, wire.RefusedError) as error:
            raise DeviceLost(f"{self._where}: {error}") from error

    def _reply(self, port: Any, request: wire.ModbusRequest) -> bytes:
        """Return the bytes received within the time limit, up to the end of the reply.

        Those that have come are read however late this thread runs, on a busy computer.
        """
        deadline_ns = self._clock.now_ns() + round(self._config.answer * SECOND_NS)
        frame, length = b"", _REFUSAL
        while len(frame) < length:
            left = max(0, deadline_ns - self._clock.now_ns()) / SECOND_NS
            if not select.select([port], [], [], left)[0]:
                break
            frame += port.read(min(max(port.in_waiting, 1), length - len(frame)))
            if len(frame) == _REFUSAL and not frame[1] & 0x80:
                length = wire.reply_length(request)
        return frame


def _hint(error: Exception) -> str:
    """Return advice on an error of opening the port."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return "; is the adapter plugged in? see /dev/serial/by-id/"
    if number == errno.EACCES:
        return "; add the user to the group dialout"
    return ""


# Change of the held object: opens, then closes repeatedly until the fingers hold something.

# An activation takes one to two seconds [s].
ACTIVATION = 5.0
# Slowest and weakest of 0 to 255, while a person's fingers are near.
_GENTLE = 0


def swap_held(
    gripper: RobotiqDriver,
    what: str,
    clock: Clock,
    say: Callable[[str], None],
    *,
    pause: float = 5.0,
    patience: float = 600.0,
    speed: int = _GENTLE,
) -> wire.GripperStatus:
    """Open the fingers and wait until `what` is between them, without any key press.

    Every `pause` seconds the fingers close, slowly and weakly, and open again if they meet nothing;
    after `patience` seconds without an object they give up. An object they meet is then held with
    the configured force. `say` prints a line for the technician.
    """
    say(f"gripper: opens in {pause:g} s: support the object it holds")
    _rest(clock, pause)
    gripper.activate(ACTIVATION)
    gripper.open_fingers()
    deadline_ns = clock.now_ns() + round(patience * SECOND_NS)
    while clock.now_ns() < deadline_ns:
        say(f"gripper: put {what} between the fingers; they close in {pause:g} s")
        _rest(clock, pause)
        if gripper.move(255, speed=speed, force=_GENTLE).holding:
            status = gripper.close_fingers()
            if status.holding:
                say(f"gripper: {status.text}")
                return status
        gripper.open_fingers()
    raise DeviceLost(f"gripper: nothing to hold in {patience:g} s; {what} was expected")


def _rest(clock: Clock, seconds: float) -> None:
    clock.sleep_until(clock.now_ns() + round(seconds * SECOND_NS))


# Supervision of the grip while the arm works, on a background thread.


def judge(status: wire.GripperStatus, reference: wire.GripperStatus, tolerance: int) -> str | None:
    """Return the reason why the grip is lost, or None while it holds.

    The reference is the status when it was known to hold; the fingers may have moved by the
    tolerance, in counts of 255.
    """
    if status.fault:
        return f"fault {status.fault}: {wire.fault_text(status.fault)}"
    if status.state != wire.ACTIVE:
        return "it is not active any more"
    if status.object == wire.AT_POSITION:
        return f"the object is gone (gOBJ 3, fingers at {status.position} of 255)"
    if not status.holding:
        return f"the fingers move (gOBJ 0, at {status.position} of 255)"
    moved = status.position - reference.position
    if abs(moved) > tolerance:
        return (
            f"the fingers moved by {moved:+d} counts of 255 (from {reference.position} to "
            f"{status.position}); allowed: {tolerance}"
        )
    return None


class GripWatch:
    """Polls one gripper and remembers the first reason why its grip is lost.

    It calls `on_lost` once, from the polling thread.
    """

    def __init__(self, config: RobotiqConfig, clock: Clock, on_lost: Callable[[], None]) -> None:
        self._config = config
        self._clock = clock
        self._on_lost = on_lost
        self._driver = RobotiqDriver(config, clock)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self.lost: str | None = None
        """Reason why the grip is lost, as text; None while it holds."""
        self.polls = 0
        """Number of answers so far."""

    def open(self, timeout: float) -> dict[str, Any]:
        """Connect, check that something is held, start polling, return its properties."""
        self._driver.open(timeout)
        status = self._driver.status()
        why = judge(status, status, self._config.position_tolerance)
        if why is not None:
            raise DeviceLost(
                f"gripper at {self._config.port}: does not hold the indenter: {why} "
                f"({status.text}); put it between the fingers, then run: tactile grip"
            )
        description = self._driver.describe()
        logger.info("preflight  gripper %s", status.text)
        self._thread = threading.Thread(target=self._run, args=(status,), name="grip")
        self._thread.start()
        return description

    def close(self) -> None:
        """Stop polling; the gripper keeps holding. May be called twice."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._driver.close()

    def _run(self, reference: wire.GripperStatus) -> None:
        pacer = Pacer(self._clock, self._config.rate_hz)
        heard_ns = self._clock.now_ns()
        while not self._ending.is_set() and self.lost is None:
            pacer.wait()
            try:
                status = self._driver.status()
            except DeviceLost as error:
                # A single corrupt answer is tolerated: motors put noise on the shared line.
                silent = (self._clock.now_ns() - heard_ns) / SECOND_NS
                if silent > self._config.silence:
                    self._lose(f"no good answer for {silent:.1f} s: {error}")
                continue
            heard_ns = self._clock.now_ns()
            self.polls += 1
            why = judge(status, reference, self._config.position_tolerance)
            if why is not None:
                self._lose(why)

    def _lose(self, why: str) -> None:
        self.lost = f"gripper: grip lost: {why}"
        self._on_lost()


class GripperStream(ReceivingDriver):
    """Stream of the status of a hand's gripper, which takes commands as well; see `Driver`."""

    def __init__(self, config: HandConfig, clock: Clock) -> None:
        super().__init__(f"gripper at {config.port}", clock, 256, ("corrupt",))
        self._config = config
        self._driver = RobotiqDriver(config, clock)
        self._pacer = Pacer(clock, config.rate_hz)

    def command(self, opening: float, speed: int, force: int) -> None:
        """Go to an opening [m] with a speed and a force of 0 to 255."""
        position = self._config.position(opening)
        self._driver.tell(wire.GripperCommand(go=True, position=position, speed=speed, force=force))

    def describe(self) -> dict[str, Any]:
        """Return properties for the session."""
        config = self._config
        more = {"per_count": config.per_count, "closed": config.closed, "rate_hz": config.rate_hz}
        return {"kind": config.KIND, "slave": config.slave, **more}

    def _connect(self, timeout: float) -> None:
        self._driver.open(timeout)
        self._pacer = Pacer(self._clock, self._config.rate_hz)
        self._receive_first("does not answer")

    def _receive(self) -> None:
        self._pacer.wait()
        config = self._config
        try:
            status = self._driver.status()
        except DeviceLost as error:
            self.rejected["corrupt"] += 1
            self._count_wait(config.answer, config.silence, str(error))
            return
        self._waits = 0
        if status.state != wire.ACTIVE:
            cure = "activate it, which closes the fingers, before sensors are on them"
            raise DeviceLost(f"{self._where}: {status.text}; {cure}")
        self._inbox.put(
            {
                "value": config.opening(status.position),
                "commanded": config.opening(status.requested),
                "current": status.current,
                "object": status.object,
                "fault": status.fault,
            }
        )

    def _release(self) -> None:
        self._driver.close()
