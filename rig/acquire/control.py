"""Operator requests to a running collection, from pedal, page or keyboard."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

from recorder.command_line.errors import EXIT_INTERRUPTED, CommandError, failure

logger = logging.getLogger(__name__)

# Ctrl-C is a request, not an exception: the current row is finished, then the arm retracts.


class Interrupted(CommandError):
    """The operator requested a stop."""

    exit_code = EXIT_INTERRUPTED

    def report(self) -> str:
        """Return the line of a command that had not begun to record."""
        return "interrupted; nothing was recorded"


class InterruptFlag:
    """Context manager that catches SIGINT, SIGTERM and SIGHUP.

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
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
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
    """Run a function in a process of its own, at this terminal, and return its exit code.

    A vendor's library may take that process down, but not this one. Ctrl-C and a closed terminal
    reach that process as well; SIGTERM, sent to this one, is passed on. This process waits until
    the other has ended in order.

    Args:
        function: A function of a module; returns an exit code.
        *arguments: Its arguments, which can be pickled.
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

    Args:
        interrupt: Requests of the terminal, which `check` raises too; None: there are none.
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
        self,
        control: Control,
        progress: Callable[[], Mapping[str, Any]],
        session: Path,
        first: int,
    ) -> None:
        """Show a running collection.

        Args:
            control: Receives the requests.
            progress: Returns the progress, as `LiveLine.progress`; may be called in any thread.
            session: Path of its session, which has the outcomes of targets before `first`.
            first: First target of this run.
        """

    def say(self, status: str, reason: str = "") -> None:
        """Show a status."""
