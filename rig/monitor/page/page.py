"""Collecting process's side of the page: sends progress, executes requests.

The thread that runs the plan never waits for the page. It leaves values that a thread of this
module reads five times per second; if the page's process hangs or dies, only that thread is
affected.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import logging
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from recorder import OUTCOMES, Session
from rig.acquire.control import Control
from rig.core.clock import SECOND_NS, Clock, SystemClock
from rig.core.errors import ConfigError
from rig.monitor.page.access import LOOPBACK_HOST, urls_of
from rig.monitor.page.messages import COMMANDS, ENDED, LETTERS, PageJob, Snapshot
from rig.monitor.page.server import LINGER, run_page

logger = logging.getLogger(__name__)

# Interval between snapshots [s]; commands are received immediately.
_PERIOD = 0.2
# Longest start of an interpreter on a busy machine [s].
_START_TIMEOUT = 30.0
_WHO = "page"
# File beside the session with the port of its page, as long as the page is served.
ADDRESS = ".tactile-page.json"
_LIMITED = OUTCOMES.index("force_limited")


class _LogLines(logging.Handler):
    """Keeps the newest lines until the page's thread fetches them."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
        self._lines: deque[str] = deque(maxlen=100)

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.append(self.format(record)[:400])

    def fetch(self) -> tuple[str, ...]:
        """Return the lines since the last call."""
        return tuple(self._lines.popleft() for _ in range(len(self._lines)))


class Page:
    """Context manager that serves the page while a collection runs.

    Args:
        job: Settings of the page.
        clock: Clock.
    """

    def __init__(self, job: PageJob, clock: Clock | None = None) -> None:
        self._job = job
        self._clock = clock or SystemClock()
        self._start_ns = self._clock.now_ns()
        self._snapshot = Snapshot(outcomes=LETTERS["open"] * len(job.spots))
        self._outcomes = list(self._snapshot.outcomes)
        self._progress: Callable[[], Mapping[str, Any]] | None = None
        self._control: Control | None = None
        self._ending = threading.Event()
        self._log = _LogLines()
        self.port = job.access.port
        """Port of the server, once started."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=run_page, args=(job, theirs), name="page")
        self._theirs = theirs
        self._thread = threading.Thread(target=self._exchange, name="page", daemon=True)

    @property
    def urls(self) -> list[str]:
        """Addresses to open, with the token if it is required. Printed, never logged.

        One for each network of this machine if the page serves all of them. They are numbers,
        since a tablet need not know this machine's name.
        """
        return urls_of(self._job.access, self.port)

    def __enter__(self) -> Page:
        self._process.start()
        self._theirs.close()
        word: str
        value: Any
        try:
            answered = self._pipe.poll(_START_TIMEOUT)
            word, value = self._pipe.recv() if answered else ("failed", "it does not start")
        except (EOFError, OSError):
            word, value = "failed", "its process ended"
        if word != "ready":
            self._stop_process()
            raise ConfigError(f"--watch: found {value}; allowed: a free port of this machine")
        self.port = value
        self._await_answer()
        self._publish(True)
        logging.getLogger().addHandler(self._log)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._snapshot.status not in ENDED:
            reason = str(error) or type(error).__name__ if error is not None else ""
            self.say("stopped", reason)
        self.close()

    def _await_answer(self) -> None:
        """Wait until the page answers a request, so that its address works when it is printed."""
        access, host = self._job.access, self._job.access.host
        at = LOOPBACK_HOST if host == "0.0.0.0" else "::1" if host == "::" else host
        client = http.client.HTTPConnection(at, self.port, timeout=_START_TIMEOUT)
        try:
            client.request("GET", f"/?token={access.token}")
            client.getresponse().read()
        except (OSError, http.client.HTTPException) as error:
            self._stop_process()
            raise ConfigError(f"--watch: {at}:{self.port} does not answer: {error}") from error
        finally:
            client.close()

    def _publish(self, serving: bool) -> None:
        """Write or remove the file by which the workbench finds this page."""
        path = self._job.session.parent / ADDRESS
        content = {"port": self.port, "session": self._job.session.name, "pid": os.getpid()}
        # The collection does not depend on it.
        with contextlib.suppress(OSError):
            if serving:
                path.write_text(json.dumps(content))
            else:
                path.unlink(missing_ok=True)

    def begin(
        self,
        control: Control,
        progress: Callable[[], Mapping[str, Any]],
        session: Path,
        first: int,
    ) -> None:
        """Show a running collection.

        Args:
            control: Receives the page's requests.
            progress: Called in a thread; returns fields of `Snapshot`, `ended` (outcomes of
                targets) and `waiting` (True during a pause).
            session: Its session; the outcomes of targets before `first` are read from it.
            first: First target of this run.
        """
        self._control, self._progress = control, progress
        if first:
            self._earlier(session, first)
        self.say("collecting")

    def say(self, status: str, reason: str = "") -> None:
        """Show a status; one of ENDED is the last."""
        self._snapshot = replace(self._snapshot, status=status, reason=reason)

    def _earlier(self, path: Path, first: int) -> None:
        segments = Session(path).segments
        limited = np.asarray(segments["target"])[np.asarray(segments["outcome"]) == _LIMITED]
        for target in range(first):
            self._outcomes[target] = LETTERS["limited" if target in limited else "done"]

    def close(self) -> None:
        """Send the final state, wait until it arrives, end the process; may be called twice."""
        logging.getLogger().removeHandler(self._log)
        self._publish(False)
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
                self._pipe.send(self._now())
                if self._pipe.poll(_PERIOD):
                    self._obey(self._pipe.recv())
            self._pipe.send(self._now())
        except (EOFError, OSError):
            if not self._ending.is_set():
                logger.warning("the monitoring page is gone; the collection continues without it")
                if self._control is not None and _WHO in self._control.paused_by:
                    # The person who paused may be at the bench: motion must not resume by itself.
                    logger.warning("the pause it requested stays: end with Ctrl-C, then resume")

    def _obey(self, command: str) -> None:
        if self._control is not None and command in COMMANDS:
            getattr(self._control, command)(_WHO)

    def _now(self) -> Snapshot:
        fields = dict(self._progress()) if self._progress is not None else {}
        for target, outcome in fields.pop("ended", {}).items():
            self._outcomes[target] = LETTERS[outcome]
        base = self._snapshot
        if fields.pop("waiting", False) and base.status == "collecting":
            base = replace(base, status="paused")
        if base.status in ENDED:
            fields = {"target": -1, "phase": "", "left": None}
        return replace(
            base,
            **fields,
            outcomes="".join(self._outcomes),
            elapsed=round((self._clock.now_ns() - self._start_ns) / SECOND_NS, 1),
            paused_by=self._control.paused_by if self._control is not None else (),
            log=self._log.fetch(),
        )
