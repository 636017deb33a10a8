"""The arm as the recording process sees it: commands go to a supervised child, which may crash.

ur_rtde ends its process with SIGSEGV when the connection drops, and a command to a controller that is
gone can hang for 300 s. So it runs in a child (`rig.arm.motion`); the child's death or silence comes
out here as DeviceLost, within a bounded time.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Literal

from numpy.typing import ArrayLike

from rig.arm import motion
from rig.arm.config import ArmConfig
from rig.arm.messages import Alarm, Close, Command, Halt, Move, Reply, Retract, Setup, Started
from rig.clock import SECOND_NS, Clock, SystemClock
from rig.errors import DeviceLost, SafetyStop
from rig.guard import GuardLimits, Mode

logger = logging.getLogger(__name__)

_SLICE = 0.05
"""How long `move` waits between two calls of `on_wait` [s]."""
_ANSWER = 10.0
"""The child answers a command, or says how long it will take, within this [s]."""
_STOP_ANSWER = 15.0
"""The same for a halt, which may have to wait for a move to end [s]."""
_EXIT = 3.0
"""A child that was told to end has this long before it is killed [s]."""


@dataclass(frozen=True, slots=True)
class MoveResult:
    """How a move ended that leaves the arm usable."""

    outcome: Literal["done", "force_limited", "stopped"]
    """At the target; ended by the soft force limit; ended short of the target otherwise."""
    start_ns: int
    """When the move was commanded [ns]."""
    end_ns: int
    """When the arm stood still [ns]."""
    reason: str = ""
    """Why it ended short of its target, for people."""


class Arm:
    """Moves one UR e-Series arm under the guard.

    Args:
        config: Address, tool and speeds.
        contact_frame: Pose (6,) of the contact frame in the base frame [m, rad]; +z leaves the
            sensor.
        limits: What the guard holds.
        force_path: FORCE_LATEST record the force stream publishes; None: no F/T sensor.
        pose_path: POSE_LATEST record the pose stream publishes; None: the child's own link.
        clock: For time limits.
    """

    def __init__(
        self,
        config: ArmConfig,
        contact_frame: ArrayLike,
        limits: GuardLimits,
        *,
        force_path: Path | None,
        pose_path: Path | None,
        clock: Clock | None = None,
    ) -> None:
        frame = tuple(float(value) for value in contact_frame)  # type: ignore[union-attr, arg-type]
        self._setup = Setup(config, frame, limits, force_path, pose_path)
        self._clock = clock or SystemClock()
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._number = motion.START
        self._replies: dict[int, Reply | Started] = {}
        self._alarm: Alarm | None = None
        self._lost = "not started"
        # Reentrant: a signal handler may call halt() while its own thread waits for a move.
        self._lock = threading.RLock()

    def start(self, timeout: float) -> None:
        """Start the child and wait until the arm obeys, at most `timeout` [s].

        Raises:
            DeviceLost: The controller does not answer, is off, in local control, or refuses.
            SafetyStop: A safety stop is active.
        """
        if self.alive:
            return
        self._discard()
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        # Daemon: at a normal exit of this process the child gets SIGTERM, halts and retracts.
        self._process = context.Process(
            target=motion.run, args=(self._setup, theirs), name="arm", daemon=True
        )
        with _signals_held():
            self._process.start()
        theirs.close()
        self._pipe, self._number = ours, motion.START
        try:
            reply = self._answer(motion.START, timeout)
        except DeviceLost:
            self._discard()
            raise
        if reply.outcome != "done":
            self._discard()
            _raise_for(reply)

    @property
    def alive(self) -> bool:
        """Whether the child runs; False after a crash, whatever the reason."""
        return self._process is not None and self._process.is_alive()

    def move(
        self,
        pose: ArrayLike,
        *,
        speed: float | None = None,
        acceleration: float | None = None,
        mode: Mode = "guarded",
        on_wait: Callable[[], None] | None = None,
    ) -> MoveResult:
        """Go straight to TCP pose (6,) in the base frame [m, rad] and wait until it has ended.

        Args:
            pose: Target.
            speed: [m/s]; default: of the configuration, by mode.
            acceleration: [m/s^2]; default likewise.
            mode: See `rig.guard.Guard`.
            on_wait: Called about 20 times a second. What it raises (or Ctrl-C) leaves the arm
                moving: call `halt`.

        Raises:
            SafetyStop: A hard limit, the box, or a safety stop of the controller.
            DeviceLost: The arm, or data the guard needs, is gone.
        """
        config = self._setup.config
        slow = mode == "guarded"
        target = tuple(float(value) for value in pose)  # type: ignore[union-attr, arg-type]
        self._number += 1
        command = Move(
            self._number,
            target,
            speed or (config.speed if slow else config.travel_speed),
            acceleration or (config.acceleration if slow else config.travel_acceleration),
            mode,
        )
        return _result(self._command(command, _ANSWER, on_wait))

    def halt(self) -> None:
        """Stop and wait for standstill; a `move` in another thread ends as "stopped".

        Raises:
            SafetyStop: The controller stands in a safety stop already.
            DeviceLost: The child or the controller is gone; the controller's watchdog stops the arm.
        """
        self._number += 1
        reply = self._command(Halt(self._number), _STOP_ANSWER, None)
        if reply.outcome != "done":
            _raise_for(reply)

    def retract(self) -> bool:
        """Halt, then leave along +z of the contact frame; False when the arm could not.

        Never raises for the arm: it is what one does on the way out.
        """
        self._number += 1
        try:
            reply = self._command(Retract(self._number), _STOP_ANSWER, None)
        except DeviceLost as error:
            logger.warning("no retract: %s", error)
            return False
        if reply.outcome != "done":
            logger.warning("no retract: %s", reply.reason)
        return reply.outcome == "done"

    def recover_and_retract(self, timeout: float = 20.0) -> bool:
        """After the child was lost: a fresh one, whose only act is to retract.

        False when the controller does not answer or stands in a safety stop, which a person has to
        look at first.
        """
        try:
            self.start(timeout)
        except (DeviceLost, SafetyStop) as error:
            logger.warning("no recovery: %s", error)
            return False
        return self.retract()

    def check(self) -> None:
        """See whether the guard found something while no command was running.

        Raises:
            SafetyStop: A hard limit or a safety stop.
            DeviceLost: The child, the arm, or data the guard needs, is gone.
        """
        self._pump(0.0)
        alarm, self._alarm = self._alarm, None
        if alarm is not None:
            lost = alarm.kind in ("stale_force", "stale_pose")
            raise (DeviceLost if lost else SafetyStop)(alarm.reason)

    def close(self) -> None:
        """Stop the arm where it is and end the child; safe twice."""
        if self.alive and self._pipe is not None:
            self._number += 1
            try:
                self._command(Close(self._number), _STOP_ANSWER, None)
            except DeviceLost as error:
                logger.warning("arm not closed in order: %s", error)
            if self._process is not None:
                self._process.join(_EXIT)
        self._discard()

    def _command(
        self, command: Command, timeout: float, on_wait: Callable[[], None] | None
    ) -> Reply:
        if self._pipe is None:
            raise DeviceLost(f"arm at {self._setup.config.host}: {self._lost}")
        try:
            self._pipe.send(command)
        except OSError:
            # A reply that says why the child ended may still be in the pipe.
            pass
        return self._answer(command.number, timeout, on_wait)

    def _answer(
        self, number: int, timeout: float, on_wait: Callable[[], None] | None = None
    ) -> Reply:
        """The reply of that number.

        Raises:
            DeviceLost: The child died, said so, or did not answer in time and was killed.
        """
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while True:
            report = self._replies.pop(number, None)
            if isinstance(report, Started):
                deadline_ns = self._clock.now_ns() + round(report.limit * SECOND_NS)
            elif report is not None:
                return report
            if self._clock.now_ns() > deadline_ns:
                self._discard(
                    "the process that moves it did not answer and was ended; the controller's "
                    "watchdog stops the arm. Is the network cable in?"
                )
                raise DeviceLost(f"arm at {self._setup.config.host}: {self._lost}")
            self._pump(_SLICE)
            if on_wait is not None:
                on_wait()

    def _pump(self, timeout: float) -> None:
        """Wait up to `timeout` [s] for a report and file it.

        Raises:
            DeviceLost: The child has ended.
        """
        with self._lock:
            pipe, process = self._pipe, self._process
            if pipe is None or process is None:
                raise DeviceLost(f"arm at {self._setup.config.host}: {self._lost}")
            wait([pipe, process.sentinel], timeout)
            try:
                if pipe.poll(0):
                    with _signals_held():
                        self._file(pipe.recv())
                    return
            except (EOFError, OSError):
                pass
            else:
                if process.is_alive():
                    return
            process.join(_EXIT)
            code = process.exitcode
            died = "crashed" if code is None or code < 0 else "ended"
            self._discard(
                f"the process that moves it {died} (exit code {code}); the controller's watchdog "
                "stops the arm. Was the connection or the power cut?"
            )
            raise DeviceLost(f"arm at {self._setup.config.host}: {self._lost}")

    def _file(self, report: Reply | Started | Alarm) -> None:
        if isinstance(report, Alarm):
            self._alarm = report
        else:
            # What nobody waits for any more would only pile up.
            self._replies = {k: v for k, v in self._replies.items() if k >= self._number - 2}
            self._replies[report.number] = report

    def _discard(self, why: str = "not started") -> None:
        """End what is left of the child: never waits for ever, leaves no zombie.

        Args:
            why: What later calls are told.
        """
        with self._lock:
            self._lost = why
            if self._process is not None:
                if self._process.is_alive():
                    self._process.kill()
                self._process.join()
                self._process.close()
                self._process = None
            if self._pipe is not None:
                self._pipe.close()
                self._pipe = None
            self._replies.clear()


@contextmanager
def _signals_held() -> Iterator[None]:
    """Ctrl-C waits outside: half a message read, or a child with the default handler, is no use."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _raise_for(reply: Reply) -> None:
    if reply.outcome == "device_lost":
        raise DeviceLost(reply.reason)
    raise SafetyStop(reply.reason)


def _result(reply: Reply) -> MoveResult:
    if reply.outcome in ("device_lost", "safety_stop"):
        _raise_for(reply)
    return MoveResult(reply.outcome, reply.start_ns, reply.end_ns, reply.reason)  # type: ignore[arg-type]
