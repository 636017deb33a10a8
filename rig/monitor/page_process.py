"""The page of a running command: a process of its own, fed by a thread.

What the command does never waits for the page. It leaves values that the thread reads five times
per second, or once it is woken; if the page's process hangs or dies, only that thread is affected.
"""

import asyncio
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any

from rig.core.clock import Clock, SystemClock
from rig.core.errors import ConfigError
from rig.monitor.access import AccessPolicy, urls_of
from rig.monitor.lab import Folders
from rig.monitor.server import LINGER, LiveView, PageServer

# Interval between messages to the page [s]; commands are received immediately.
_PERIOD = 0.2
# Longest start of an interpreter on a busy machine [s].
_START_TIMEOUT = 60.0


class PageProcess:
    """Context manager that serves the page, with a live view of a job, while a command runs.

    If the lab has no folder of sessions, only the live view is served.
    """

    option: str
    """Option of the command with the address, for error messages."""

    def __init__(
        self,
        access: AccessPolicy,
        folders: Folders,
        view: Callable[[Any, Clock], LiveView],
        job: object,
    ) -> None:
        self._access = access
        self._ending = threading.Event()
        self.port = access.port
        """Port of the server, once started."""
        context = multiprocessing.get_context("spawn")
        self._pipe, self._far_end = context.Pipe()
        self._woken = os.eventfd(0)
        arguments = (access, folders, view, job, self._far_end)
        self._process = context.Process(target=run_page, args=arguments, name="page")
        self._thread = threading.Thread(target=self._exchange, name="page", daemon=True)

    def message(self) -> object:
        """Return what the view receives next; called in a thread."""
        raise NotImplementedError

    def obey(self, command: str) -> None:
        """Carry out a command of the page; called in a thread."""

    def lost(self) -> None:
        """Note that the page's process is gone; called in a thread."""

    @property
    def urls(self) -> list[str]:
        """Addresses to open, see `urls_of`. Printed, never logged."""
        return urls_of(self._access, self.port)

    def wake(self) -> None:
        """Let the thread send the next message at once."""
        os.eventfd_write(self._woken, 1)

    def start(self) -> None:
        """Start the process, and wait until it serves the page."""
        self._process.start()
        self._far_end.close()
        answer: Any
        try:
            started = self._pipe.poll(_START_TIMEOUT)
            answer = self._pipe.recv() if started else "it does not start"
        except (EOFError, OSError):
            answer = "its process ended"
        if isinstance(answer, str):
            self._stop_process()
            raise ConfigError(f"{self.option}: {answer}")
        self.port = answer
        self._thread.start()

    def close(self) -> None:
        """Send the last message, wait until it arrives, end the process; may be called twice."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(_PERIOD + 1.0)
        if not self._thread.is_alive():
            self._process.join(LINGER + 2.0)
        self._stop_process()

    def _stop_process(self) -> None:
        if self._process.is_alive():
            self._process.kill()
        self._process.join()
        if self._thread.is_alive():
            # It was blocked on the killed process and ends now.
            self._thread.join()
        self._pipe.close()

    def _exchange(self) -> None:
        try:
            while not self._ending.is_set():
                self._pipe.send(self.message())
                ready = wait([self._pipe, self._woken], _PERIOD)
                if self._woken in ready:
                    os.eventfd_read(self._woken)
                if self._pipe in ready:
                    self.obey(self._pipe.recv())
            self._pipe.send(self.message())
        except (EOFError, OSError):
            if not self._ending.is_set():
                self.lost()


def run_page(
    access: AccessPolicy,
    folders: Folders,
    make_view: Callable[[Any, Clock], LiveView],
    job: object,
    pipe: Connection,
) -> None:
    """Run the page's process; it sends its port, or why there is none, then commands."""
    # Ctrl-C is handled by the command, which ends this process through the pipe.
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Recording has priority over all clients.
    os.nice(10)
    clock = SystemClock()
    view = make_view(job, clock)

    def ready(port: int) -> None:
        pipe.send(port)
        view.start()

    lab = folders if folders.sessions.is_dir() else None
    try:
        server = PageServer(access, lab, clock, view, pipe)
        asyncio.run(server.run(ready))
    except ConfigError as error:
        pipe.send(str(error))
    finally:
        view.close()
        pipe.close()
