"""Requests to a running collection, from pedal, page or keyboard, and interlocks."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import socket
import stat
import sys
import threading
from collections.abc import Callable, Mapping
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol

from recorder.command_line.errors import EXIT_INTERRUPTED, CommandError, failure
from rig.bench.bench import Bench
from rig.core.clock import Clock
from rig.core.errors import DeviceLost, SafetyStop, all_opened
from rig.devices.hid.settings import PedalConfig

if TYPE_CHECKING:
    from rig.devices.gripper.robotiq import GripWatch
    from rig.devices.hid.drivers import DeadMan, PedalState, PedalWatch

logger = logging.getLogger(__name__)

# Ctrl-C is a request, not an exception: the current row is finished, then the arm retracts.


class Interrupted(CommandError):
    """The operator requested a stop."""

    exit_code = EXIT_INTERRUPTED

    def report(self) -> str:
        """Return the line of a command that had not begun to record."""
        return "interrupted; nothing was recorded"


class InterruptFlag:
    """Context manager that catches SIGINT, SIGQUIT, SIGTERM and SIGHUP.

    The first signal sets `requested`; a second raises KeyboardInterrupt immediately, until `ignore`
    is called. SIGHUP, sent when the terminal is closed, never counts as a second: a closing
    terminal may send several. It stays ignored if it was before, as under nohup.
    """

    def __init__(self) -> None:
        self.requested = False
        self._reason = "interrupted by the operator"
        self._ignored = False
        self._forward: BaseProcess | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> InterruptFlag:
        for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def forward_to(self, process: BaseProcess) -> None:
        """Pass SIGTERM on to a process; the other signals reach the whole group of processes."""
        self._forward = process

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM and self._forward is not None:
            self._forward.terminate()
        if number == signal.SIGHUP:
            discard_output_of_a_closed_terminal()
            if not self.requested:
                self._reason = "the terminal was closed"
        elif self.requested and not self._ignored:
            raise KeyboardInterrupt
        self.requested = True

    def ignore(self) -> None:
        """Ignore further signals: the arm is retracting and the session is being closed."""
        self._ignored = True

    def check(self) -> None:
        """Raise `Interrupted` if a stop was requested."""
        if self.requested:
            raise Interrupted(self._reason)


def discard_output_of_a_closed_terminal() -> None:
    """Redirect standard output and error to /dev/null if their terminal is gone.

    Each further line printed would raise an error, and one must not keep the arm from retracting.
    The log file beside the session still receives all messages.
    """
    for stream in (sys.stdout, sys.stderr):
        # Streams without a file, as in tests, raise an OSError too.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            number = stream.fileno()
            if stat.S_ISCHR(os.fstat(number).st_mode) and not os.isatty(number):
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, number)
                os.close(null)


def apart(function: Callable[..., int], *arguments: object) -> int:
    """Run a function of a module in a process of its own, at this terminal; return its exit code.

    A vendor's library may take that process down, but not this one. Ctrl-C and a closed terminal
    reach that process as well; SIGTERM, sent to this one, is passed on. This process waits until
    the other has ended in order.
    """
    # Both processes write to the same terminal, so the buffer is flushed first.
    sys.stdout.flush()
    with InterruptFlag() as interrupt:
        process = multiprocessing.get_context("spawn").Process(
            target=_at_terminal, args=(function, arguments)
        )
        process.start()
        interrupt.forward_to(process)
        while process.exitcode is None:
            with contextlib.suppress(KeyboardInterrupt):
                process.join()
        stopped = interrupt.requested or process.exitcode < 0
        return EXIT_INTERRUPTED if stopped else process.exitcode


def _at_terminal(function: Callable[..., int], arguments: tuple[object, ...]) -> None:
    """Call the function in its process, with this terminal's input, which `spawn` has put aside."""
    with open(0, closefd=False) as sys.stdin:
        try:
            code = function(*arguments)
        except BaseException as error:
            code = failure(error, "nothing was recorded")
        sys.exit(code)


class Control:
    """Pause, resume and abort: requested by any thread, executed by the thread that runs the plan.

    A pause takes effect before the next target, with the tip clear of the surface. An abort ends
    the collection like Ctrl-C: the current phase is finished, the arm retracts, all data is kept.
    Requests of the terminal, if there is one, are those of `interrupt`.
    """

    def __init__(self, interrupt: InterruptFlag | None = None) -> None:
        self._interrupt = interrupt
        self._lock = threading.Lock()
        self._paused_by: set[str] = set()
        self._aborted_by: str | None = None

    def pause(self, who: str) -> None:
        """Request a pause before the next target."""
        with self._lock:
            if who not in self._paused_by:
                logger.info("pause requested by the %s", who)
            self._paused_by.add(who)

    def resume(self, who: str) -> None:
        """Withdraw the pause requested by `who`; pauses of others remain."""
        with self._lock:
            if who in self._paused_by:
                logger.info("resumed by the %s", who)
            self._paused_by.discard(who)

    def abort(self, who: str) -> None:
        """Request the end of the collection; cannot be withdrawn."""
        with self._lock:
            if self._aborted_by is None:
                logger.info("abort requested by the %s", who)
                self._aborted_by = who

    @property
    def paused_by(self) -> tuple[str, ...]:
        """Sources of the current pause requests, in alphabetical order; empty: not paused."""
        with self._lock:
            return tuple(sorted(self._paused_by))

    def check(self) -> None:
        """Raise `Interrupted` if the end was requested, by a signal or an abort."""
        if self._interrupt is not None:
            self._interrupt.check()
        with self._lock:
            if self._aborted_by is not None:
                raise Interrupted(f"aborted by the {self._aborted_by}")


class Onlooker(Protocol):
    """Display of a running collection that may pause or end it, such as the monitoring page."""

    def begin(
        self, control: Control, progress: Callable[[], Mapping[str, Any]], session: Path, first: int
    ) -> None:
        """Show a running collection, whose first target is `first`; send requests to `control`.

        `progress` returns that of `LiveLine.progress`, in any thread. The session at this path has
        the outcomes of the targets before.
        """

    def say(self, status: str, reason: str = "") -> None:
        """Show a status."""


# Interlocks that do not record: the gripper that holds the indenter, and the foot pedal. Each is
# watched by its own thread. `wake` notifies the plan runner, which then calls `check` and acts.
# Their properties are in the session's run entry, under `devices`.


# Source of the pauses that the pedal requests.
PEDAL = "foot pedal"


class DeadManReleased(Exception):
    """The dead-man pedal is not held: the arm must not press."""


class Interlocks:
    """Gripper and pedal of a bench, if any; a pedal of mode `pause` pauses `control`."""

    def __init__(self, bench: Bench, control: Control, clock: Clock) -> None:
        self._timeout = bench.preflight.timeout
        self.control = control
        self._waker, self.wake = socket.socketpair()
        """Socket that becomes readable when `check` should be called."""
        for end in (self._waker, self.wake):
            end.setblocking(False)
        self._grip: GripWatch | None = None
        self._pedal: PedalWatch | None = None
        self._dead_man: DeadMan | None = None
        self._config: PedalConfig | None = bench.pedal
        # Imported here, so that a bench without them does not need their libraries.
        if bench.gripper is not None:
            from rig.devices.gripper.robotiq import GripWatch

            self._grip = GripWatch(bench.gripper, clock, self._tell)
        if bench.pedal is not None:
            from rig.devices.hid.drivers import DeadMan, PedalWatch

            self._pedal = PedalWatch(bench.pedal, clock, self._on_pedal)
            self._dead_man = DeadMan() if bench.pedal.mode == "dead_man" else None

    def __enter__(self) -> Interlocks:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> dict[str, dict[str, Any]]:
        """Connect to all devices, start watching, and return their properties by device."""
        opens: dict[str, Callable[[], dict[str, Any]]] = {}
        if self._grip is not None:
            opens["gripper"] = partial(self._grip.open, self._timeout)
        if self._pedal is not None:
            opens["pedal"] = self._pedal.open
        return all_opened(opens)

    def check(self, *, pressing: bool = False) -> None:
        """Raise if an interlock forbids it; while pressing, a dead-man pedal must be held."""
        with contextlib.suppress(BlockingIOError):
            while self.wake.recv(64):
                pass
        if self._grip is not None and self._grip.lost is not None:
            raise SafetyStop(self._grip.lost)
        self._check_pedal_is_in()
        if pressing and self._dead_man is not None and self._pedal is not None:
            state = self._pedal.state
            if not self._dead_man.held(state):
                done = "released" if state.out_since_ns is None else "unplugged"
                raise DeadManReleased(f"the foot pedal was {done}")

    def armed(self) -> bool:
        """Return True if the arm may press: no dead-man pedal, or a pedal that is pressed.

        The pedal must have been pressed after its last release, and after the last `disarm`.
        """
        dead_man, pedal = self._dead_man, self._pedal
        return dead_man is None or pedal is None or dead_man.armed(pedal.state)

    def disarm(self) -> None:
        """Require a new press; one made while the arm was still leaving does not count."""
        if self._dead_man is not None and self._pedal is not None:
            self._dead_man.disarm(self._pedal.state)

    @property
    def wish(self) -> str:
        """Instruction to the operator for arming a dead-man pedal, for the progress line."""
        if self._pedal is None or self._config is None:
            return ""
        if self._pedal.state.out_since_ns is not None:
            limit = self._config.unplugged_limit
            return f"the foot pedal is unplugged: plug it in (lost after {limit:g} s)"
        if self._pedal.state.down:
            return "let go of the foot pedal, then press and hold it"
        return "press and hold the foot pedal"

    def close(self) -> None:
        """Stop watching; may be called twice."""
        for watch in (self._grip, self._pedal):
            if watch is not None:
                watch.close()
        self._waker.close()
        self.wake.close()

    def _check_pedal_is_in(self) -> None:
        if self._pedal is None or self._config is None:
            return
        out = self._pedal.out_for
        if out is not None and out > self._config.unplugged_limit:
            raise DeviceLost(
                f"foot pedal at {self._config.device}: unplugged for {out:.1f} s; allowed: "
                f"{self._config.unplugged_limit:g} s"
            )

    def _on_pedal(self, before: PedalState, after: PedalState) -> None:
        if self._dead_man is None:
            if after.out_since_ns is not None:
                # A user who relies on the pedal must not find it missing when it is needed.
                self.control.pause(PEDAL)
            elif after.presses > before.presses:
                if PEDAL in self.control.paused_by:
                    self.control.resume(PEDAL)
                else:
                    self.control.pause(PEDAL)
        self._tell()

    def _tell(self) -> None:
        with contextlib.suppress(OSError):
            # Full: nothing has been read yet, and one byte suffices.
            self._waker.send(b"!")
