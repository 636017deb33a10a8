"""The process that moves the arm: it owns ur_rtde, polls the guard and obeys the pipe.

ur_rtde crashes its process when the connection drops (SIGSEGV), so it lives here, under the
supervision of `rig.devices.arm.arm`. A closed pipe means that the recording process is gone: the
arm halts and retracts, and this process ends. After a protective or emergency stop no command is
sent.
"""

import logging
import multiprocessing
import operator
import os
import signal
import threading
from collections.abc import Callable
from functools import partial, reduce
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import numpy as np

from rig.core.clock import SECOND_NS, Clock, Pacer, SystemClock
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.geometry import Array, invert, rotation_between, transform
from rig.core.guard import (
    Kind,
    Mode,
    MotionGuard,
    Violation,
    judge_safety,
    most_serious,
    outside_box,
)
from rig.core.samples import POSE_LATEST
from rig.core.shared_memory import AwaitedRecord
from rig.devices.arm import dashboard
from rig.devices.arm.messages import (
    START,
    Alarm,
    Command,
    Move,
    Note,
    Order,
    Outcome,
    Reply,
    Report,
    Setup,
    Started,
)
from rig.devices.arm.reader import RtdeLink
from rig.devices.arm.vendor import UrControl, check_ready

logger = logging.getLogger(__name__)

# If the newest pose of our own link is older than this, ur_rtde may hang: do not call it [s].
_FRESH = 0.1
# At rest below this speed [m/s, rad/s], which is above the noise of the controller's estimate.
_STILL, _STILL_TURN = 1e-3, 1e-2


class Watch:
    """State of arm and sensors as known to the arm's process, updated by `look`."""

    def __init__(self, setup: Setup, link: RtdeLink, clock: Clock) -> None:
        self._host = setup.config.host
        self._settle_ns = round(setup.config.settle * SECOND_NS)
        self._link = link
        self._clock = clock
        self._motion = MotionGuard(setup.limits, setup.contact_frame)
        self._shared_pose = setup.pose_path is not None
        self._pose = AwaitedRecord(setup.pose_path, POSE_LATEST)
        self._guards = [
            (AwaitedRecord(path, guard.RECORD), path.stem, guard) for path, guard in setup.guards
        ]
        self._sample: dict[str, Any] | None = None
        self._moved_ns = self._slid_ns = clock.now_ns()
        self.speed_fraction = 1.0
        """Speed slider, 0..1."""
        self.armed = False
        """True once the streams have been needed; before that, missing streams are no alarm."""

    @property
    def pose(self) -> Array | None:
        """TCP pose (6,) in the base frame, from our own link [m, rad]; None before the first."""
        return None if self._sample is None else np.array(self._sample["value"])

    def look(self, mode: Mode) -> Violation | None:
        """Process all samples since the last look and return the most serious violation."""
        arrived = self._link.receive(0.0)
        for sample in arrived:
            self._take(sample)
        own = arrived or ([] if self._sample is None else [self._sample])
        status = reduce(operator.or_, (sample["safety_status"] for sample in own), 0)
        safety = judge_safety(status)
        if safety is not None:
            return safety
        poses = self._pose.unread() if self._shared_pose else _pose_records(own)
        now_ns = self._clock.now_ns()
        violations = [self._motion.check(now_ns, poses, mode)]
        for record, name, guard in self._guards:
            violations.append(guard.check(now_ns, record.unread(), mode, self._motion.travelled))
            if record.missed and mode != "retreat":
                violations.append(_overrun(name, record.missed))
        return most_serious(each for each in violations if each is not None)

    def look_again(self, timeout: float) -> Violation | None:
        """Wait up to `timeout` [s] for an abnormal safety status; return its violation or None."""
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while self._clock.now_ns() < deadline_ns:
            for sample in self._link.receive(0.01):
                self._take(sample)
                violation = judge_safety(sample["safety_status"])
                if violation is not None:
                    return violation
        return None

    def _take(self, sample: dict[str, Any]) -> None:
        self._sample = sample
        if self.speed_fraction != (fraction := float(sample["speed_fraction"])):
            self.speed_fraction, self._slid_ns = fraction, sample["t_ns"]
        speed = sample["speed"]
        if max(map(abs, speed[:3])) > _STILL or max(map(abs, speed[3:])) > _STILL_TURN:
            self._moved_ns = sample["t_ns"]

    def slider_at_rest(self) -> bool:
        """Return True if nobody has moved the speed slider for the last half second."""
        return self._clock.now_ns() - self._slid_ns > SECOND_NS // 2

    def fresh(self) -> bool:
        """Return True if the controller has just been heard from."""
        if self._sample is None:
            return False
        age_ns: int = self._clock.now_ns() - self._sample["t_ns"]
        return age_ns <= round(_FRESH * SECOND_NS)

    def require_fresh(self) -> None:
        """Ensure that it is safe to call ur_rtde."""
        if self.fresh():
            return
        # Our own process may have been delayed: samples waiting in the socket count.
        for sample in self._link.receive(_FRESH):
            self._take(sample)
        if not self.fresh():
            raise DeviceLost(
                f"arm at {self._host}: silent; is the controller on and its network cable in?"
            )

    def still(self) -> bool:
        """Return True if the TCP has been at rest for the settling time."""
        return self.fresh() and self._clock.now_ns() - self._moved_ns > self._settle_ns

    def distance(self, goal: Array) -> float:
        """Return the distance from the TCP to pose (6,) `goal` [m]."""
        pose = self.pose
        return 0.0 if pose is None else float(np.linalg.norm(goal[:3] - pose[:3]))

    def near(self, goal: Array, distance: float, angle: float) -> bool:
        """Return True if the TCP is at pose (6,) `goal` within `distance` [m], `angle` [rad]."""
        pose = self.pose
        if pose is None or self.distance(goal) > distance:
            return False
        return float(np.linalg.norm(rotation_between(pose, goal))) <= angle


def _pose_records(samples: list[dict[str, Any]]) -> np.ndarray | None:
    """Return POSE_LATEST records (n,) of the link's samples; None without any."""
    if not samples:
        return None
    records = np.zeros(len(samples), POSE_LATEST)
    for record, sample in zip(records, samples, strict=True):
        for field in ("t_ns", "safety_status", "value"):
            record[field] = sample[field]
    return records


def _overrun(name: str, missed: int) -> Violation:
    return Violation(
        "stale_force",
        f"{missed} records of {name} passed between two looks of the guard: the computer is too "
        "busy to watch them",
    )


# One command at a time, to its end (move, halt, retract), each supervised by the guard.
#
# All movements are asynchronous, so that the watchdog is kicked and the guard polled while they
# last. A move has ended when the controller's operation word reports its end and the TCP is at rest
# at the target; each of these waits has a time limit.

_LOOP_HZ = 250.0
# Kicks in the time after which the watchdog stops the arm: one may be late.
_KICKS = 2.5
# Tolerance of arrival [m, rad]: several times the arm's repeatability (0.03 mm).
_AT_TARGET, _AT_ANGLE = 2e-4, 2e-3
# Time to come to rest at the target after the controller reports the move finished [s].
_ARRIVING = 1.0
# Longest duration of a stop [s]: from 50 mm/s at 2 m/s^2 it takes 25 ms.
_STOPPING = 3.0
# Path length that may take as long as a turn of 1 rad [m/rad].
_STEEPEST = 0.5
_SAFETY: tuple[Kind, ...] = ("protective_stop", "emergency_stop")
_LOST: tuple[Kind, ...] = ("stale_force", "stale_pose")


class Mover:
    """A connected arm that executes one command after the other.

    `interrupted` is called in every cycle of a move; True ends the move by a halt. An exception it
    raises is passed on with the arm still moving. `say` is called with a note for the operator.
    """

    def __init__(
        self,
        setup: Setup,
        control: UrControl,
        watch: Watch,
        clock: Clock,
        interrupted: Callable[[], bool],
        say: Callable[[str], None] = logger.warning,
    ) -> None:
        self._say = say
        self._said_fraction = 1.0
        self._kicked_ns = clock.now_ns()
        self._setup = setup
        self._config = setup.config
        self._control = control
        self._watch = watch
        self._clock = clock
        self._interrupted = interrupted
        self._pacer = Pacer(clock, _LOOP_HZ)
        self._kick_every_ns = round(SECOND_NS / (_KICKS * self._config.watchdog_hz))
        self.latched: Violation | None = None
        """Safety stop after which no command is sent any more."""

    def wait_for_pose(self, timeout: float) -> None:
        """Run the loop until the first pose has arrived."""
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while self._watch.pose is None:
            self.step("retreat")
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"arm at {self._config.host}: no pose for {timeout} s")

    def step(self, mode: Mode) -> Violation | None:
        """Run one cycle of the loop: wait, check poses and forces, kick the watchdog."""
        self._pacer.wait()
        violation = self._watch.look(mode)
        if violation is not None and violation.kind in _SAFETY:
            self.latched = violation
        fraction = self._watch.speed_fraction
        if fraction != self._said_fraction and self._watch.slider_at_rest():
            self._said_fraction = fraction
            if fraction < 1:
                self._say(_slow(fraction))
        # By the clock, as late cycles are skipped. Nothing is sent to a controller that has fallen
        # silent: the call could hang for 300 s.
        due = self._clock.now_ns() - self._kicked_ns >= self._kick_every_ns
        if due and self.latched is None and self._watch.fresh():
            violation = self._kick() or violation
        return violation

    def _kick(self) -> Violation | None:
        """Kick the watchdog; return the safety stop that ended the program, if one did."""
        before_ns, self._kicked_ns = self._kicked_ns, self._clock.now_ns()
        if self._control.connected() and self._control.kick():
            return None
        # The safety status may reach us one package after the program's end.
        self.latched = self._watch.look_again(0.1)
        if self.latched is None:
            try:
                why = self._why_stopped((self._kicked_ns - before_ns) / SECOND_NS)
            except SafetyStop as stop:
                self.latched = Violation("emergency_stop", str(stop))
                return self.latched
            where = f"arm at {self._config.host}"
            raise DeviceLost(f"{where}: the control program stopped on the controller: {why}")
        return self.latched

    def _why_stopped(self, silent: float) -> str:
        """Return why the program ended; `silent` is the time since the kick before the last [s]."""
        if silent * self._config.watchdog_hz > 1:
            slowest = f"watchdog {self._config.watchdog_hz:g} Hz"
            return f"this computer sent no command for {silent:.2f} s ({slowest})"
        try:
            dashboard.check_ready(self._config.host, _CONNECT)
        except DeviceLost as error:
            return str(error)
        return "stopped at the pendant"

    def halt(self) -> None:
        """Stop and wait until at rest; do nothing after a safety stop, which stops by itself."""
        if self.latched is not None:
            return
        self._watch.require_fresh()
        before, _ = self._control.operation()
        self._control.start_stop(self._config.stop_deceleration)
        deadline_ns = self._clock.now_ns() + round(_STOPPING * SECOND_NS)
        while self.latched is None:
            self.step("retreat")
            operation, running = self._control.operation()
            if operation != before and not running and self._watch.still():
                return
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"arm at {self._config.host}: did not stop in {_STOPPING} s")

    def retract_command(self, number: int) -> Move:
        """Return the move away along +z of the contact frame, up to the top of the box."""
        config = self._config
        pose = self._watch.pose
        if pose is None:
            raise DeviceLost(f"arm at {config.host}: no pose yet")
        frame = np.array(self._setup.contact_frame)
        position = transform(invert(frame), pose[:3])
        room = max(0.0, self._setup.limits.box[1][2] - float(position[2]))
        position[2] += min(config.retract, room)
        goal = (*transform(frame, position).tolist(), *pose[3:].tolist())
        return Move(number, goal, config.travel_speed, config.travel_acceleration, "retreat")

    def move(self, command: Move, on_start: Callable[[float], None]) -> Reply:
        """Execute a move and return its result; `on_start` gets the longest time it takes [s]."""
        start_ns = self._clock.now_ns()
        goal = np.array(command.pose)
        if command.mode != "retreat":
            self._watch.armed = True
            reason = outside_box(self._setup.limits, self._setup.contact_frame, goal[:3])
            if reason is not None:
                why = f"target: {reason}"
                return self.reply(command.number, "safety_stop", start_ns, why, "box")
        violation = self.step(command.mode)
        if violation is not None:
            return self._violation_reply(command, start_ns, violation)
        self._watch.require_fresh()
        if not self._control.reaches(goal.tolist()):
            return self._refused(command, start_ns, "finds the target out of reach")
        limit = self._time_limit(command, goal, on_start)
        before, _ = self._control.operation()
        start_ns = self._clock.now_ns()
        if not self._control.start_move(goal.tolist(), command.speed, command.acceleration):
            return self._refused(command, start_ns, "refused the move")
        return self._follow(command, goal, before, start_ns, limit, on_start)

    def _refused(self, command: Move, start_ns: int, what: str) -> Reply:
        # A command also fails when the program has just ended: report that instead.
        violation = self._watch.look_again(0.05) or self.step(command.mode) or self._kick()
        if violation is not None:
            return self._violation_reply(command, start_ns, violation)
        return self.reply(command.number, "stopped", start_ns, f"the controller {what}")

    def _follow(
        self,
        command: Move,
        goal: Array,
        before: int,
        start_ns: int,
        limit: float,
        on_start: Callable[[float], None],
    ) -> Reply:
        """Supervise a move that has begun until it has ended."""
        deadline_ns = start_ns + round(limit * SECOND_NS)
        finished_ns: int | None = None
        fraction = self._watch.speed_fraction
        while True:
            violation = self.step(command.mode)
            if violation is not None:
                self.halt()
                return self._violation_reply(command, start_ns, violation)
            if self._interrupted():
                self.halt()
                return self.reply(command.number, "stopped", start_ns, "halted by the operator")
            now_ns = self._clock.now_ns()
            operation, running = self._control.operation()
            # Only a number other than before the call belongs to it: see UrControl.operation.
            if operation != before and not running:
                finished_ns = finished_ns or now_ns
                if self._watch.still() and self._watch.near(goal, _AT_TARGET, _AT_ANGLE):
                    return self.reply(command.number, "done", start_ns)
                if now_ns - finished_ns > round(_ARRIVING * SECOND_NS):
                    away = self._watch.distance(goal) * 1e3
                    why = f"came to rest {away:.2f} mm off its target"
                    return self.reply(command.number, "stopped", start_ns, why)
            elif fraction != self._watch.speed_fraction:
                fraction = self._watch.speed_fraction
                limit = self._time_limit(command, goal, on_start)
                deadline_ns = now_ns + round(limit * SECOND_NS)
            elif now_ns > deadline_ns:
                self.halt()
                paused = "is the program paused at the pendant?"
                cause = _slow(fraction) if fraction < 1 else paused
                why = f"took longer than {limit:.1f} s: {cause}"
                return self.reply(command.number, "stopped", start_ns, why)

    def _violation_reply(self, command: Move, start_ns: int, violation: Violation) -> Reply:
        if violation.kind in _SAFETY:
            self.latched = violation
        outcome: Outcome = "safety_stop"
        if violation.kind == "force_soft":
            outcome = "force_limited"
        elif violation.kind in _LOST:
            outcome = "device_lost"
        return self.reply(command.number, outcome, start_ns, violation.reason, violation.kind)

    def reply(
        self,
        number: int,
        outcome: Outcome,
        start_ns: int,
        reason: str = "",
        kind: Kind | None = None,
    ) -> Reply:
        """Return the reply to the command of this number, which ends now."""
        return Reply(number, outcome, start_ns, self._clock.now_ns(), reason, kind)

    def _time_limit(self, command: Move, goal: Array, on_start: Callable[[float], None]) -> float:
        """Return and announce 1.5 times the duration at the present slider, plus 2 s [s]."""
        pose = self._watch.pose
        angle = 0.0 if pose is None else float(np.linalg.norm(rotation_between(pose, goal)))
        length = max(self._watch.distance(goal), angle * _STEEPEST)
        ideal = length / command.speed + command.speed / command.acceleration
        limit = 2.0 + 1.5 * ideal / max(self._watch.speed_fraction, 0.05)
        on_start(limit + _STOPPING + 1.0)
        return limit


def _slow(fraction: float) -> str:
    """Return a note on a speed slider below 1."""
    if fraction < 0.005:
        return "the speed slider is at 0%: nothing moves until it is raised at the pendant"
    return f"the speed slider is at {fraction:.0%}: moves take {1 / fraction:.2g} times as long"


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
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
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
        check_ready(setup.config.host, _CONNECT)
        link = RtdeLink(setup.config.host, min(setup.config.rate_hz, _LINK_HZ), clock)
        link.open(_CONNECT)
        control = UrControl(setup.config)
    except (DeviceLost, SafetyStop) as error:
        outcome: Outcome = "device_lost" if isinstance(error, DeviceLost) else "safety_stop"
        pipe.send(Reply(START, outcome, start_ns, clock.now_ns(), str(error)))
        return 1
    motion = Motion(setup, pipe, control, link, clock)
    signal.signal(signal.SIGTERM, lambda *_: motion.end())
    return motion.serve()


class Motion:
    """One connected arm and the pipe that brings its commands.

    `link` is our own pose stream: standstill, safety status, and proof that the arm is there.
    """

    def __init__(
        self, setup: Setup, pipe: Connection, control: UrControl, link: RtdeLink, clock: Clock
    ) -> None:
        self._pipe: Connection | None = pipe
        self._control = control
        self._clock = clock
        self._watch = Watch(setup, link, clock)
        self._mover = Mover(setup, control, self._watch, clock, self._command_waits, self._say)
        self._ending = False

    def end(self) -> None:
        """Treat the parent as gone at the next poll of the pipe (for SIGTERM)."""
        self._ending = True

    def serve(self) -> int:
        """Obey commands until closed, and return the exit code."""
        number = START
        try:
            self._mover.wait_for_pose(_CONNECT)
            self._send(self._mover.reply(START, "done", self._clock.now_ns()))
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
            self._send(self._mover.reply(number, "device_lost", self._clock.now_ns(), str(error)))
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
        latched, reply = self._mover.latched, partial(self._mover.reply, command.number)
        if what == "close":
            self._control.close()
            self._send(reply("done", start_ns))
        elif latched is not None:
            self._send(reply("safety_stop", start_ns, latched.reason, latched.kind))
        elif isinstance(command, Move):
            self._move(command)
        elif what == "retract":
            self._move(self._mover.retract_command(command.number))
        else:
            self._send(reply("done", start_ns))

    def _move(self, move: Move) -> None:
        self._send(self._mover.move(move, lambda limit: self._send(Started(move.number, limit))))

    def _next_command(self) -> Command:
        """Wait for a command, reporting each kind of guard violation at most once meanwhile."""
        reported: set[Kind] = {"force_soft", "box"}  # Resting in contact or outside is no alarm.
        while not self._command_waits():
            violation = self._mover.step("guarded")
            if violation is not None and self._watch.armed and violation.kind not in reported:
                reported.add(violation.kind)
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

    def _say(self, text: str) -> None:
        self._send(Note(text))

    def _send(self, report: Report) -> None:
        try:
            if self._pipe is not None:
                self._pipe.send(report)
        except OSError:
            # The parent is gone: handled where commands are read.
            self._ending = True
