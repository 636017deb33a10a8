"""The process that moves the arm: it owns ur_rtde, polls the guard and obeys the pipe.

ur_rtde crashes its process when the connection drops (SIGSEGV), so it lives here, under the
supervision of `rig.devices.arm.arm`. A closed pipe means that the recording process is gone:
the arm halts and retracts, and this process ends. After a protective or emergency stop no command
is sent.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import Connection
from typing import NoReturn

from rig.core.clock import Clock, SystemClock
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.guard import Kind
from rig.devices.arm.messages import (
    START,
    Alarm,
    Command,
    Move,
    Order,
    Outcome,
    Reply,
    Report,
    Setup,
    Started,
)
from rig.devices.arm.mover import Mover, Watch
from rig.devices.arm.reader import RtdeLink
from rig.devices.arm.settings import ArmConfig
from rig.devices.arm.vendor import UrControl, check_ready

logger = logging.getLogger(__name__)

_LINK_HZ = 250.0
# Time limit for each connection, and for the first pose, at start [s].
_CONNECT = 2.0
# Without a parent, this process has halted, retracted and ended by then, or an alarm ends it [s].
_LEAVING = 20


class _ParentGoneError(Exception):
    """The pipe is closed, or we were asked to end: nobody will command this arm again."""


def run(setup: Setup, pipe: Connection) -> NoReturn:
    """Run the child process: serve `pipe` until it is asked to close, then exit without cleanup."""
    threading.Thread(target=_outlive_briefly, name="parent", daemon=True).start()
    # Ctrl-C and a closed terminal reach the whole group; only the parent decides how to react.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    # ur_rtde prints to stdout, which the parent uses for its results.
    os.dup2(2, 1)
    code = 1
    try:
        code = _serve(setup, pipe)
    except DeviceLost as error:
        logger.error("%s", error)
    except BaseException:
        logger.exception("the process that moves the arm failed")
    finally:
        # Not sys.exit: destructors of a control interface whose robot is gone can hang or crash.
        os._exit(code)


def _outlive_briefly() -> None:
    """Ensure that this process does not outlive its parent for long.

    A command sent to a controller that is gone too hangs inside ur_rtde for up to 300 s, during
    which no Python code runs. The default action of the alarm needs none.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        signal.alarm(_LEAVING)


def _serve(setup: Setup, pipe: Connection) -> int:
    clock = SystemClock()
    start_ns = clock.now_ns()
    try:
        link, control = _connected(setup.config, clock)
    except (DeviceLost, SafetyStop) as error:
        outcome: Outcome = "device_lost" if isinstance(error, DeviceLost) else "safety_stop"
        pipe.send(Reply(START, outcome, start_ns, clock.now_ns(), str(error)))
        return 1
    motion = Motion(setup, pipe, control, link, clock)
    signal.signal(signal.SIGTERM, lambda *_: motion.end())
    return motion.serve()


def _connected(config: ArmConfig, clock: Clock) -> tuple[RtdeLink, UrControl]:
    """Return the open pose link and the running control of an arm."""
    check_ready(config.host, _CONNECT)
    link = RtdeLink(config.host, min(config.rate_hz, _LINK_HZ), clock)
    link.open(_CONNECT)
    return link, UrControl(config)


class Motion:
    """One connected arm and the pipe that brings its commands.

    `link` is our own pose stream: standstill, safety status, and proof that the arm is there.
    """

    def __init__(
        self,
        setup: Setup,
        pipe: Connection,
        control: UrControl,
        link: RtdeLink,
        clock: Clock,
    ) -> None:
        self._pipe: Connection | None = pipe
        self._control = control
        self._clock = clock
        self._watch = Watch(setup, link, clock)
        self._mover = Mover(setup, control, self._watch, clock, self._command_waits)
        self._ending = False

    def end(self) -> None:
        """Treat the parent as gone at the next poll of the pipe (for SIGTERM)."""
        self._ending = True

    def serve(self) -> int:
        """Obey commands until closed, and return the exit code."""
        number = START
        try:
            self._mover.wait_for_pose(_CONNECT)
            self._reply(START, "done", self._clock.now_ns())
            while True:
                command = self._next_command()
                number = command.number
                self._obey(command)
                if isinstance(command, Order) and command.what == "close":
                    return 0
        except _ParentGoneError:
            self._leave()
            return 0
        except DeviceLost as error:
            self._reply(number, "device_lost", self._clock.now_ns(), str(error))
            return 1

    def _leave(self) -> None:
        """Halt and retract after losing the parent, unless a safety stop forbids it."""
        self._ending = False
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        self._mover.halt()
        if self._mover.latched is None:
            reply = self._mover.move(self._mover.retract_command(0), lambda limit: None)
            logger.warning("the recording process is gone: retract %s", reply.outcome)
        self._control.close()

    def _obey(self, command: Command) -> None:
        start_ns = self._clock.now_ns()
        what = None if isinstance(command, Move) else command.what
        if what is not None:
            self._mover.halt()
        latched = self._mover.latched
        if what == "close":
            self._control.close()
            self._reply(command.number, "done", start_ns)
        elif latched is not None:
            self._reply(command.number, "safety_stop", start_ns, latched.reason, latched.kind)
        elif isinstance(command, Move):
            self._move(command)
        elif what == "retract":
            self._move(self._mover.retract_command(command.number))
        else:
            self._reply(command.number, "done", start_ns)

    def _move(self, move: Move) -> None:
        self._send(self._mover.move(move, lambda limit: self._send(Started(move.number, limit))))

    def _next_command(self) -> Command:
        """Wait for a command, reporting each kind of guard violation at most once meanwhile."""
        told: set[Kind] = {"force_soft", "box"}  # Resting in contact or outside is no alarm.
        while not self._command_waits():
            violation = self._mover.step("guarded")
            if violation is not None and self._watch.armed and violation.kind not in told:
                told.add(violation.kind)
                self._send(Alarm(violation.kind, violation.reason))
        try:
            if self._pipe is None:
                raise _ParentGoneError
            command: Command = self._pipe.recv()
            return command
        except (EOFError, OSError) as error:
            raise _ParentGoneError from error

    def _command_waits(self) -> bool:
        """Return True if the pipe has data to read or is closed; nothing is consumed."""
        if self._ending:
            raise _ParentGoneError
        try:
            return self._pipe is not None and self._pipe.poll(0)
        except OSError as error:
            raise _ParentGoneError from error

    def _reply(
        self,
        number: int,
        outcome: Outcome,
        start_ns: int,
        reason: str = "",
        kind: Kind | None = None,
    ) -> None:
        self._send(Reply(number, outcome, start_ns, self._clock.now_ns(), reason, kind))

    def _send(self, report: Report) -> None:
        try:
            if self._pipe is not None:
                self._pipe.send(report)
        except OSError:
            # The parent is gone: handled where commands are read.
            self._ending = True
