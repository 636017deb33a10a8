"""The child process from its parent's side: commands out, replies in, crashes contained.

The child may crash (ur_rtde, SIGSEGV) or hang (a command to a controller that is gone: 300 s). Both
are reported as DeviceLost within a bounded time, and leave no zombie.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import NoReturn, Protocol

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import DeviceLost
from rig.devices.arm.messages import START, Alarm, Command, Reply, Report, Setup, Started

# Interval between two calls of `on_wait` in `ask` [s].
_SLICE = 0.05
# After its last report a child has this long to end before it is killed [s].
_EXIT = 3.0


class HasFileno(Protocol):
    """Object that can be waited for: a socket, a connection."""

    def fileno(self) -> int:
        """Return the file descriptor."""


def _move_arm(setup: Setup, pipe: Connection) -> NoReturn:
    """Run the arm's process, which alone loads what moves the arm."""
    from rig.devices.arm import motion

    motion.run(setup, pipe)


class Child:
    """One child process at a time, and the pipe to it. Safe to use from several threads.

    Args:
        setup: Configuration of the child.
        clock: Clock for time limits.
    """

    def __init__(self, setup: Setup, clock: Clock) -> None:
        self._setup = setup
        self._clock = clock
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._numbers = itertools.count(START + 1)
        self._reports: dict[int, Reply | Started] = {}
        self._where = f"arm at {setup.config.host}"
        self._lost = f"{self._where}: not started"
        # Reentrant: a signal handler may halt while its own thread waits for a move.
        self._lock = threading.RLock()
        self.alarm: Alarm | None = None
        """Last alarm raised by the guard while no command was running."""

    @property
    def alive(self) -> bool:
        """True while the process runs; False after any crash."""
        with self._lock:
            return self._process is not None and self._process.is_alive()

    @property
    def pid(self) -> int | None:
        """Process id, None without a process."""
        return self._process.pid if self._process is not None else None

    def start(self, timeout: float) -> Reply:
        """Start a new process and return its first reply."""
        self.discard()
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
        return self._answer(START, timeout, None)

    def ask(
        self,
        make: Callable[[int], Command],
        timeout: float,
        on_wait: Callable[[], None] | None = None,
        wake: HasFileno | None = None,
    ) -> Reply:
        """Send the command that `make` builds from a number, and return the reply to it.

        Args:
            make: Called once.
            timeout: For the reply, or for the report of its start and time limit [s].
            on_wait: Called about 20 times a second; an exception leaves the command running.
            wake: When it becomes readable, `on_wait` is called at once and must drain it.
        """
        number = next(self._numbers)
        command = make(number)
        with self._lock:
            pipe = self._require_pipe()
            # A child that has just ended may have left the reason in the pipe: continue reading.
            with contextlib.suppress(OSError), _interrupts_held():
                pipe.send(command)
        return self._answer(number, timeout, on_wait, wake)

    def poll(self) -> None:
        """File the reports that have arrived."""
        self._pump(0.0)

    def _require_pipe(self) -> Connection:
        if self._pipe is None:
            raise DeviceLost(self._lost)
        return self._pipe

    def _answer(
        self,
        number: int,
        timeout: float,
        on_wait: Callable[[], None] | None,
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
                    self.join()
                    self.discard(report.reason)
                return report
            if self._clock.now_ns() > deadline_ns:
                self.discard(
                    f"{self._where}: the process that moves it did not answer and was ended; "
                    "the controller's watchdog stops the arm. Is the network cable in?"
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
                f"{self._where}: the process that moves it {died} (exit code {code}); "
                "the controller's watchdog stops the arm. Was the connection or the power cut?"
            )
            for report in self._reports.values():
                # Between two commands, the reason comes under the number of the last one.
                if isinstance(report, Reply) and report.outcome == "device_lost":
                    why = report.reason
            self.discard(why)
            self._require_pipe()

    def _file(self, report: Report) -> None:
        if isinstance(report, Alarm):
            self.alarm = report
            return
        self._reports[report.number] = report
        # Replies nobody waits for any more, after an interrupted move, must not accumulate.
        for number in sorted(self._reports)[:-8]:
            del self._reports[number]

    def discard(self, why: str | None = None) -> None:
        """End the child, if any, within bounded time and without leaving a zombie.

        Args:
            why: Message of the error that later calls raise.
        """
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
            self.alarm = None

    def join(self) -> None:
        """Wait for a child that was asked to end."""
        if self._process is not None:
            self._process.join(_EXIT)


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Defer Ctrl-C and hang-up: half a message, or a child without its handlers, is useless."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
