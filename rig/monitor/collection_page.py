"""Collecting process's side of the page: sends progress, executes requests."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

from recorder import OUTCOMES, Session
from rig.acquire.control import Control
from rig.core.clock import SECOND_NS, SystemClock
from rig.monitor.collection import COMMANDS, ENDED, CollectionJob, CollectionView, Snapshot
from rig.monitor.finished import LETTERS
from rig.monitor.lab import ADDRESS
from rig.monitor.page_process import PageProcess, PageSettings

logger = logging.getLogger(__name__)

_WHO = "page"
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


class CollectionPage(PageProcess):
    """Context manager that serves the page while a collection runs.

    Args:
        settings: Settings of the page.
        job: The collection.
    """

    def __init__(self, settings: PageSettings, job: CollectionJob) -> None:
        super().__init__(settings, CollectionView, job)
        self._clock = SystemClock()
        self._start_ns = self._clock.now_ns()
        self._snapshot = Snapshot(outcomes=LETTERS["open"] * len(job.targets))
        self._outcomes = list(self._snapshot.outcomes)
        self._progress: Callable[[], Mapping[str, Any]] | None = None
        self._control: Control | None = None
        self._log = _LogLines()
        # By this file `tactile page` finds the page of a collection.
        self._address = job.session.parent / ADDRESS
        self._session = job.session.name

    def __enter__(self) -> CollectionPage:
        self.start()
        content = {"port": self.port, "session": self._session, "pid": os.getpid()}
        # The collection does not depend on it.
        with contextlib.suppress(OSError):
            self._address.write_text(json.dumps(content))
        logging.getLogger().addHandler(self._log)
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

    def begin(
        self,
        control: Control,
        progress: Callable[[], Mapping[str, Any]],
        session: Path,
        first: int,
    ) -> None:
        """Show a running collection; see `rig.acquire.control.Onlooker`."""
        self._control, self._progress = control, progress
        if first:
            segments = Session(session).segments
            limited = segments["target"][segments["outcome"] == _LIMITED]
            for target in range(first):
                self._outcomes[target] = LETTERS["limited" if target in limited else "done"]
        self.say("collecting")

    def say(self, status: str, reason: str = "") -> None:
        """Show a status; one of ENDED is the last."""
        self._snapshot = replace(self._snapshot, status=status, reason=reason)

    def close(self) -> None:
        """Send the final state, wait until it arrives, end the process; may be called twice."""
        logging.getLogger().removeHandler(self._log)
        with contextlib.suppress(OSError):
            self._address.unlink(missing_ok=True)
        super().close()

    def lost(self) -> None:
        """Note that the page's process is gone."""
        logger.warning("the monitoring page is gone; the collection continues without it")
        if self._control is not None and _WHO in self._control.paused_by:
            # The person who paused may be at the bench: motion must not resume by itself.
            logger.warning("the pause it requested stays: end with Ctrl-C, then resume")

    def obey(self, command: str) -> None:
        """Pause, resume or abort the collection."""
        if self._control is not None and command in COMMANDS:
            getattr(self._control, command)(_WHO)

    def message(self) -> Snapshot:
        """Return the progress of the collection."""
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
