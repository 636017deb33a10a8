"""The arm as seen by the recording process: commands run in a supervised child, which may crash.

The child may crash (ur_rtde, SIGSEGV) or hang (a command to a controller that is gone: 300 s). Both
are reported as DeviceLost within a bounded time, and leave no zombie.

An end that leaves the arm usable is returned as a `MoveResult`. Otherwise DeviceLost is raised (the
arm, or data the guard needs, is gone) or SafetyStop (a hard limit, or a controller safety stop).
"""

import contextlib
import itertools
import logging
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Literal, NoReturn, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rig.core.clock import SECOND_NS, Clock, SystemClock
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.guard import Guard, GuardLimits, Mode
from rig.devices.arm.messages import (
    START,
    Alarm,
    Command,
    Move,
    Note,
    Order,
    Reply,
    Report,
    Setup,
    Started,
)
from rig.devices.arm.settings import ArmConfig

logger = logging.getLogger(__name__)

# Starting an interpreter may take this long on a busy computer, apart from the arm itself [s].
_START = 20.0
# Within this time the child answers a move or reports how long it will take [s].
_ANSWER = 10.0
# The same for a halt, which may have to wait for a move to end [s].
_STOP_ANSWER = 5.0
# Interval between two calls of `on_wait` [s].
_SLICE = 0.05
# After its last report a child has this long to end before it is killed [s].
_EXIT = 3.0


class HasFileno(Protocol):
    """Object that can be waited for: a socket, a connection."""

    def fileno(self) -> int:
        """Return the file descriptor."""


@dataclass(frozen=True, slots=True)
class MoveResult:
    """Result of a move that leaves the arm usable."""

    outcome: Literal["done", "force_limited", "stopped"]
    """At the target; ended by the soft force limit; otherwise ended short of the target."""
    start_ns: int
    """Time of the command [ns]."""
    end_ns: int
    """Time at which the arm was at rest [ns]."""
    reason: str = ""
    """Reason for ending short of the target, as text."""


class Arm:
    """Moves one UR e-Series arm under the guard. Safe to use from several threads.

    The contact frame is a pose (6,) in the base frame [m, rad]; +z leaves the sensor. `pose_path`
    is the POSE_LATEST record of the pose stream; None: the child's own link. `guards` has the
    shared record of each gauge, or of what stands in for one, and its guard.
    """

    def __init__(
        self,
        config: ArmConfig,
        contact_frame: ArrayLike,
        limits: GuardLimits,
        *,
        pose_path: Path | None,
        guards: Mapping[Path, Guard],
        clock: Clock | None = None,
    ) -> None:
        self._config = config
        self._setup = Setup(
            config, _floats(contact_frame), limits, pose_path, tuple(guards.items())
        )
        self._clock = clock or SystemClock()
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._numbers = itertools.count(START + 1)
        self._reports: dict[int, Reply | Started] = {}
        self._where = f"arm at {config.host}"
        self._lost = f"{self._where}: not started"
        # Last one raised by the guard while no command was running.
        self._alarm: Alarm | None = None
        # Reentrant: a signal handler may halt while its own thread waits for a move.
        self._lock = threading.RLock()

    def start(self, timeout: float) -> None:
        """Start the child and wait at most `timeout` [s], once it runs, until the arm is ready."""
        if self.alive:
            return
        self._discard()
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        # Daemon: at a normal exit of this process the child gets SIGTERM, halts and retracts.
        self._process = context.Process(
            target=_move_arm, args=(self._setup, theirs), name="arm", daemon=True
        )
        self._pipe, self._numbers = ours, itertools.count(START + 1)
        try:
            with _interrupts_held():
                self._process.start()
        finally:
            theirs.close()
        reply = self._answer(START, _START + timeout)
        if reply.outcome != "done":
            self._discard(reply.reason)
            _raise_for(reply)

    @property
    def alive(self) -> bool:
        """True while the child runs; False after any crash."""
        with self._lock:
            return self._process is not None and self._process.is_alive()

    def move(
        self,
        pose: ArrayLike,
        *,
        speed: float | None = None,
        acceleration: float | None = None,
        mode: Mode = "guarded",
        on_wait: Callable[[], None] | None = None,
        wake: HasFileno | None = None,
    ) -> MoveResult:
        """Move straight to TCP pose (6,) in the base frame [m, rad] and wait for it to end.

        Speed [m/s] and acceleration [m/s^2] are by default those for travel or near contact, by the
        mode of the guard. `on_wait` is called about 20 times a second, and at once when `wake` is
        readable, which it must drain. An exception that it raises (or Ctrl-C) leaves the arm
        moving: call `halt`.
        """
        config, target = self._config, _floats(pose)
        slow = mode == "guarded"
        speed = speed or (config.speed if slow else config.travel_speed)
        acceleration = acceleration or (config.acceleration if slow else config.travel_acceleration)
        reply = self._ask(
            lambda number: Move(number, target, speed, acceleration, mode), _ANSWER, on_wait, wake
        )
        if reply.outcome == "device_lost" or reply.outcome == "safety_stop":
            _raise_for(reply)
        return MoveResult(reply.outcome, reply.start_ns, reply.end_ns, reply.reason)

    def halt(self) -> None:
        """Stop and wait until the arm is at rest; a `move` in another thread ends as "stopped"."""
        reply = self._ask(partial(Order, what="halt"), _STOP_ANSWER)
        if reply.outcome != "done":
            _raise_for(reply)

    def retract(self) -> bool:
        """Halt, then move away along +z of the contact frame; return False if the arm could not.

        Does not raise when the arm is lost, since it is called while shutting down.
        """
        try:
            reply = self._ask(partial(Order, what="retract"), _STOP_ANSWER)
        except DeviceLost as error:
            logger.warning("no retract: %s", error)
            return False
        if reply.outcome != "done":
            logger.warning("no retract: %s", reply.reason)
        return reply.outcome == "done"

    def recover_and_retract(self, timeout: float = 20.0) -> bool:
        """Start a new child after the last one was lost, and retract first.

        Returns False when the controller does not answer or is in a safety stop, whose cause a
        person must check first.
        """
        try:
            self.start(timeout)
        except (DeviceLost, SafetyStop) as error:
            logger.warning("no recovery: %s", error)
            return False
        return self.retract()

    def check(self) -> None:
        """Raise if the guard found a problem while no command was running."""
        self._pump(0.0)
        alarm, self._alarm = self._alarm, None
        if alarm is not None:
            lost = alarm.kind in ("stale_force", "stale_pose")
            raise (DeviceLost if lost else SafetyStop)(alarm.reason)

    def close(self) -> None:
        """Stop the arm in place and end the child; may be called twice."""
        if self.alive:
            try:
                self._ask(partial(Order, what="close"), _STOP_ANSWER)
                self._join()
            except DeviceLost as error:
                logger.warning("arm not closed in order: %s", error)
        self._discard()

    def _ask(
        self,
        make: Callable[[int], Command],
        timeout: float,
        on_wait: Callable[[], None] | None = None,
        wake: HasFileno | None = None,
    ) -> Reply:
        """Send the command that `make` builds from a number, and return the reply to it.

        The time limit [s] is for the reply, or for the report of its start and time limit;
        `on_wait` and `wake` are as in `move`.
        """
        number = next(self._numbers)
        command = make(number)
        with self._lock:
            pipe = self._require_pipe()
            # A child that has just ended may have left the reason in the pipe: continue reading.
            with contextlib.suppress(OSError), _interrupts_held():
                pipe.send(command)
        return self._answer(number, timeout, on_wait, wake)

    def _require_pipe(self) -> Connection:
        if self._pipe is None:
            raise DeviceLost(self._lost)
        return self._pipe

    def _answer(
        self,
        number: int,
        timeout: float,
        on_wait: Callable[[], None] | None = None,
        wake: HasFileno | None = None,
    ) -> Reply:
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while True:
            with self._lock:
                report = self._reports.pop(number, None)
            if isinstance(report, Started):
                deadline_ns = self._clock.now_ns() + round(report.limit * SECOND_NS)
            elif report is not None:
                if report.outcome == "device_lost" and report.kind is None:
                    # The child's last report (a violation has a kind): let it end before anybody
                    # checks whether it is alive.
                    self._join()
                    self._discard(report.reason)
                return report
            if self._clock.now_ns() > deadline_ns:
                self._discard(
                    f"{self._where}: the process that moves it did not answer and was ended, so "
                    "the controller's watchdog stops the arm; is the network cable in?"
                )
                self._require_pipe()
            self._pump(_SLICE, wake)
            if on_wait is not None:
                on_wait()

    def _pump(self, timeout: float, wake: HasFileno | None = None) -> None:
        """Wait up to `timeout` [s] for a report and file it, or detect that the child is dead."""
        with self._lock:
            pipe, process = self._require_pipe(), self._process
            if process is None:
                return
            wait([pipe, process.sentinel, *(() if wake is None else (wake,))], timeout)
            try:
                if pipe.poll(0):
                    with _interrupts_held():
                        self._file(pipe.recv())
                    return
                if process.is_alive():
                    return
            except (EOFError, OSError):
                pass
            process.join(_EXIT)
            code = process.exitcode
            died = "crashed" if code is None or code < 0 else "ended"
            why = (
                f"{self._where}: the process that moves it {died} (exit code {code}), so "
                "the controller's watchdog stops the arm; was the connection or the power cut?"
            )
            for report in self._reports.values():
                # Between two commands, the reason comes under the number of the last one.
                if isinstance(report, Reply) and report.outcome == "device_lost":
                    why = report.reason
            self._discard(why)
            self._require_pipe()

    def _file(self, report: Report) -> None:
        if isinstance(report, Alarm):
            self._alarm = report
            return
        if isinstance(report, Note):
            logger.warning("arm: %s", report.text)
            return
        self._reports[report.number] = report
        # Replies nobody waits for any more, after an interrupted move, must not accumulate.
        for number in sorted(self._reports)[:-8]:
            del self._reports[number]

    def _discard(self, why: str | None = None) -> None:
        """End the child within bounded time, without leaving a zombie; later calls raise `why`."""
        with self._lock:
            self._lost = why or f"{self._where}: not started"
            if self._process is not None:
                if self._process.pid is not None:
                    self._process.join(0)
                    self._process.kill()
                    self._process.join()
                self._process.close()
                self._process = None
            if self._pipe is not None:
                self._pipe.close()
                self._pipe = None
            self._reports.clear()
            self._alarm = None

    def _join(self) -> None:
        if self._process is not None:
            self._process.join(_EXIT)


def _move_arm(setup: Setup, pipe: Connection) -> NoReturn:
    """Run the arm's process, which alone loads what moves the arm."""
    from rig.devices.arm import mover

    mover.run(setup, pipe)


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Defer Ctrl-C and hang-up: half a message, or a child without its handlers, is useless."""
    held = {signal.SIGINT, signal.SIGQUIT, signal.SIGHUP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, held)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _floats(values: ArrayLike) -> tuple[float, ...]:
    return tuple(np.asarray(values, np.float64).tolist())


def _raise_for(reply: Reply) -> NoReturn:
    if reply.outcome == "device_lost":
        raise DeviceLost(reply.reason)
    raise SafetyStop(reply.reason)
