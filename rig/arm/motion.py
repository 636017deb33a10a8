"""The process that moves the arm: owns ur_rtde, watches the guard, obeys the pipe.

ur_rtde crashes its process when the connection drops (SIGSEGV), so it lives here, under the
supervision of `rig.arm.arm.Arm`. When the pipe closes, the one who recorded is gone: the arm halts,
retracts and this process ends. After a protective or emergency stop nothing is commanded any more.
"""

from __future__ import annotations

import logging
import os
import signal
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import numpy as np

from rig.arm.guarding import Watch
from rig.arm.messages import (
    Alarm,
    Close,
    Command,
    Halt,
    Move,
    Outcome,
    Reply,
    Report,
    Retract,
    Setup,
    Started,
)
from rig.arm.reader import RtdeLink
from rig.arm.rotation import Array, compose, invert, rotation_between, transform
from rig.arm.vendor import UrControl, check_ready
from rig.clock import SECOND_NS, Clock, Pacer, SystemClock
from rig.errors import DeviceLost, SafetyStop
from rig.guard import Kind, Mode, Verdict, outside_box

logger = logging.getLogger(__name__)

START = 1
"""Number of the reply that says the child is ready, or why not."""

_LOOP_HZ = 250.0
_KICK_TICKS = 10
# 25 kicks a second: two may be late before a watchdog of 10 Hz stops the arm.
_CONNECT = 2.0
"""Per connection at start [s]."""
_AT_TARGET, _AT_ANGLE = 2e-4, 2e-3
"""What counts as arrived [m, rad]: several times the arm's repeatability (0.03 mm)."""
_ARRIVING = 1.0
"""After the controller calls a move finished it has this long to be at rest at the target [s]."""
_STOPPING = 3.0
"""A stop takes at most this long [s]: 50 mm/s at 2 m/s^2 takes 25 ms."""
_STEEPEST = 0.5
"""A turn of 1 rad may take as long as this many metres [m/rad]."""
_LATCHED: tuple[Kind, ...] = ("protective_stop", "emergency_stop")
_LOST: tuple[Kind, ...] = ("stale_force", "stale_pose")


class _ParentGoneError(Exception):
    """The pipe is closed, or we were told to end: nobody will command this arm again."""


def run(setup: Setup, pipe: Connection) -> NoReturn:
    """Entry of the child process: serve `pipe` until told to close, then leave without clean-up."""
    # Ctrl-C in the terminal reaches the whole group; only the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # ur_rtde prints to stdout, which belongs to the parent's results.
    os.dup2(2, 1)
    code = 1
    try:
        code = _serve(setup, pipe)
    except BaseException:
        logger.exception("arm process ended")
    finally:
        # Not sys.exit: destructors of a control interface whose robot is gone can hang or crash.
        os._exit(code)


def _serve(setup: Setup, pipe: Connection) -> int:
    clock = SystemClock()
    host = setup.config.host
    now_ns = clock.now_ns()
    try:
        check_ready(host, _CONNECT)
        link = RtdeLink(host, min(setup.config.rate_hz, _LOOP_HZ), clock)
        link.open(_CONNECT)
        control = UrControl(setup.config)
    except (DeviceLost, SafetyStop) as error:
        outcome: Outcome = "device_lost" if isinstance(error, DeviceLost) else "safety_stop"
        pipe.send(Reply(START, outcome, now_ns, clock.now_ns(), str(error)))
        return 1
    motion = Motion(setup, pipe, control, link, clock)
    signal.signal(signal.SIGTERM, lambda *_: motion.end())
    return motion.serve()


class Motion:
    """One connected arm and the pipe its commands come from.

    Args:
        setup: What to hold.
        pipe: Commands in, reports out.
        control: The running control program.
        link: Pose stream of our own: tells standstill, safety status, and that the arm is there.
        clock: Paces the loop.
    """

    def __init__(
        self, setup: Setup, pipe: Connection, control: UrControl, link: RtdeLink, clock: Clock
    ) -> None:
        self._setup = setup
        self._config = setup.config
        self._pipe = pipe
        self._control = control
        self._clock = clock
        self._watch = Watch(setup, link, clock)
        self._pacer = Pacer(clock, _LOOP_HZ)
        self._tick = 0
        self._ending = False
        self._latched: Verdict | None = None

    def end(self) -> None:
        """Treat the parent as gone at the next look at the pipe (SIGTERM)."""
        self._ending = True

    def serve(self) -> int:
        """Obey until closed; returns the exit code."""
        number = START
        try:
            self._wait_for_pose()
            self._send(Reply(START, "done", self._clock.now_ns(), self._clock.now_ns()))
            while True:
                command = self._idle()
                number = command.number
                if isinstance(command, Close):
                    self._halt()
                    self._control.close()
                    self._reply(command, "done", self._clock.now_ns())
                    return 0
                self._obey(command)
        except _ParentGoneError:
            self._leave()
            return 0
        except DeviceLost as error:
            now_ns = self._clock.now_ns()
            self._send(Reply(number, "device_lost", now_ns, now_ns, str(error)))
            return 1

    def _leave(self) -> None:
        """The last act without a parent: halt and retract, unless a safety stop forbids it."""
        self._ending = False
        self._pipe.close()
        self._halt()
        self._retract(0)
        self._control.close()

    def _wait_for_pose(self) -> None:
        deadline_ns = self._clock.now_ns() + round(_CONNECT * SECOND_NS)
        while self._watch.pose is None:
            self._step("retreat")
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"arm at {self._config.host}: no pose for {_CONNECT} s")

    def _obey(self, command: Command) -> None:
        start_ns = self._clock.now_ns()
        if self._latched is not None:
            self._reply(command, "safety_stop", start_ns, self._latched)
        elif isinstance(command, Halt):
            self._halt()
            self._reply(command, "done", start_ns)
        elif isinstance(command, Retract):
            self._halt()
            self._retract(command.number)
        elif isinstance(command, Move):
            self._move(command)

    def _idle(self) -> Command:
        """Wait for a command; what the guard finds meanwhile is told once."""
        told: Kind | None = None
        while True:
            verdict = self._step("guarded")
            if verdict is not None and self._watch.armed and verdict.kind != told:
                # Resting in contact above the soft limit, or outside the box, is not an alarm.
                if verdict.kind not in ("force_soft", "box"):
                    told = verdict.kind
                    self._send(Alarm(verdict.kind, verdict.reason))
            command = self._take_command()
            if command is not None:
                return command

    def _take_command(self) -> Command | None:
        if self._ending:
            raise _ParentGoneError
        try:
            if self._pipe.closed or not self._pipe.poll(0):
                return None
            command: Command = self._pipe.recv()
            return command
        except (EOFError, OSError) as error:
            raise _ParentGoneError from error

    def _send(self, report: Report) -> None:
        try:
            if not self._pipe.closed:
                self._pipe.send(report)
        except OSError:
            # A closed pipe is found, and acted on, where commands are read.
            self._ending = True

    def _reply(
        self, command: Command, outcome: Outcome, start_ns: int, why: Verdict | str = ""
    ) -> None:
        reason, kind = (why, None) if isinstance(why, str) else (why.reason, why.kind)
        self._send(
            Reply(command.number, outcome, start_ns, self._clock.now_ns(), reason, kind)
        )

    def _step(self, mode: Mode) -> Verdict | None:
        """One turn of the loop: wait, look at poses and forces, kick the watchdog.

        Raises:
            DeviceLost: The controller is silent, or no longer runs our program.
        """
        self._pacer.wait()
        verdict = self._watch.look(mode)
        if verdict is not None and verdict.kind in _LATCHED:
            self._latched = verdict
        self._tick += 1
        # Nothing is sent to a controller that has fallen silent: the call could hang for 300 s.
        if self._tick % _KICK_TICKS == 0 and self._latched is None and self._watch.fresh():
            if not self._control.connected() or not self._control.kick():
                # The safety status may reach us one package after the program's end.
                verdict = self._watch.look_again(0.1)
                if verdict is None or verdict.kind not in _LATCHED:
                    raise DeviceLost(
                        f"arm at {self._config.host}: the control program stopped on the "
                        "controller: stopped at the pendant, or commands came too slowly "
                        f"(watchdog {self._config.watchdog_hz:g} Hz)"
                    )
                self._latched = verdict
        return verdict

    def _halt(self) -> None:
        """Stop and wait for standstill; nothing after a safety stop, where the arm stands already."""
        if self._latched is not None:
            return
        self._watch.require_fresh()
        before, _ = self._control.operation()
        self._control.start_stop(self._config.stop_deceleration)
        deadline_ns = self._clock.now_ns() + round(_STOPPING * SECOND_NS)
        while self._latched is None:
            self._step("retreat")
            operation, running = self._control.operation()
            if operation != before and not running and self._watch.still():
                return
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"arm at {self._config.host}: did not stop in {_STOPPING} s")

    def _retract(self, number: int) -> None:
        """Leave along +z of the contact frame, by `retract` or up to the top of the box."""
        config = self._config
        pose = self._watch.pose
        if pose is None or self._latched is not None:
            return
        frame = np.array(self._setup.contact_frame)
        place = transform(invert(frame), pose[:3])
        rise = min(config.retract, max(0.0, self._setup.limits.box[1][2] - float(place[2])))
        goal = compose(frame, [*place[:2], place[2] + rise, 0.0, 0.0, 0.0])
        goal[3:] = pose[3:]
        self._move(
            Move(
                number,
                tuple(goal.tolist()),
                config.travel_speed,
                config.travel_acceleration,
                "retreat",
            )
        )

    def _move(self, command: Move) -> None:
        start_ns = self._clock.now_ns()
        goal = np.array(command.pose)
        if command.mode != "retreat":
            self._watch.armed = True
            reason = outside_box(self._setup.limits, self._setup.contact_frame, goal[:3])
            if reason is not None:
                self._reply(command, "safety_stop", start_ns, Verdict("box", f"target: {reason}"))
                return
        verdict = self._step(command.mode)
        if verdict is not None:
            self._end_by(command, start_ns, verdict, moving=False)
            return
        self._watch.require_fresh()
        if not self._control.reaches(goal.tolist()):
            self._step(command.mode)
            self._reply(command, "stopped", start_ns, "the controller finds the target out of reach")
            return
        limit = self._time_limit(command, goal)
        self._send(Started(command.number, limit + _STOPPING + 1.0))
        before, _ = self._control.operation()
        start_ns = self._clock.now_ns()
        if self._control.start_move(goal.tolist(), command.speed, command.acceleration):
            self._follow(command, goal, before, start_ns, start_ns + round(limit * SECOND_NS))
        else:
            self._step(command.mode)
            self._reply(command, "stopped", start_ns, "the controller refused the move")

    def _follow(
        self, command: Move, goal: Array, before: int, start_ns: int, deadline_ns: int
    ) -> None:
        """Watch a move that has begun until it has ended, and reply."""
        finished_ns: int | None = None
        while True:
            verdict = self._step(command.mode)
            if verdict is not None:
                self._end_by(command, start_ns, verdict, moving=True)
                return
            now_ns = self._clock.now_ns()
            if self._interrupted():
                self._halt()
                self._reply(command, "stopped", start_ns, "halted by the operator")
                return
            operation, running = self._control.operation()
            if operation != before and not running:
                finished_ns = finished_ns or now_ns
                if self._watch.still() and self._watch.near(goal, _AT_TARGET, _AT_ANGLE):
                    self._reply(command, "done", start_ns)
                    return
                if now_ns - finished_ns > round(_ARRIVING * SECOND_NS):
                    away = self._watch.distance(goal)
                    self._reply(
                        command, "stopped", start_ns, f"came to rest {away * 1e3:.2f} mm off target"
                    )
                    return
            elif now_ns > deadline_ns:
                self._halt()
                self._reply(
                    command,
                    "stopped",
                    start_ns,
                    "took too long: is the speed slider low or the program paused at the pendant?",
                )
                return

    def _interrupted(self) -> bool:
        """Whether another command waits; it stays in the pipe. A closed pipe halts and retracts."""
        if self._ending:
            raise _ParentGoneError
        try:
            return not self._pipe.closed and self._pipe.poll(0)
        except OSError as error:
            raise _ParentGoneError from error

    def _end_by(self, command: Move, start_ns: int, verdict: Verdict, *, moving: bool) -> None:
        """Stop first, then say why."""
        if moving:
            self._halt()
        outcome: Outcome = "safety_stop"
        if verdict.kind == "force_soft":
            outcome = "force_limited"
        elif verdict.kind in _LOST:
            outcome = "device_lost"
        self._reply(command, outcome, start_ns, verdict)

    def _time_limit(self, command: Move, goal: Array) -> float:
        """How long the move may take [s], half as long again as it should, speed slider included."""
        pose: Any = self._watch.pose
        angle = float(np.linalg.norm(rotation_between(pose, goal)))
        length = max(self._watch.distance(goal), angle * _STEEPEST)
        ideal = length / command.speed + command.speed / command.acceleration
        return 2.0 + 1.5 * ideal / max(self._watch.speed_fraction, 0.05)
