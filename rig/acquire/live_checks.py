"""Witnesses of `recorder.checks` at work while a session is recorded.

A process of its own, of the lowest priority, reads the session as it grows, and takes a tenth of
a core at most. The collection asks it between two presses, which takes some microseconds.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from recorder import Session, SessionError, doubts
from recorder.findings import Finding
from recorder.spec import LATE
from rig.core.clock import SECOND_NS

# Shortest time between two looks [s], and that over the time that the last one took.
_PERIOD, _REST = 0.5, 9.0


class LiveChecks:
    """Finds doubts of a session while it is recorded."""

    def __init__(self, session: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_run, args=(session, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def new(self) -> Iterator[Finding]:
        """Yield the findings since the last call, one for each code and place."""
        with contextlib.suppress(EOFError, OSError):  # its process is gone, and has told why
            while self._pipe.poll():
                yield self._pipe.recv()

    def close(self) -> None:
        """End the process; may be called twice."""
        self._process.kill()
        self._process.join()


def look(session: Path, pipe: Connection) -> None:
    """Send the doubts of a session that grows, each code and place once, until the pipe ends."""
    looked: dict[str, Any] = {}
    known: set[tuple[str, str]] = set()
    phases, rest = 0, 0.0
    while not pipe.poll(max(_PERIOD, rest)):
        began = sum(os.times()[:2])
        # It may not be there yet, and a file may be exchanged while it is read: at the next look.
        with contextlib.suppress(SessionError, OSError):
            grown = Session(session)
            if grown.status == "recording" and _has_more(grown, phases):
                phases = len(grown.segments["end_ns"])
                for finding in doubts(grown, looked=looked):
                    if (key := (finding.code, finding.where)) not in known:
                        known.add(key)
                        pipe.send(finding)
        rest = _REST * (sum(os.times()[:2]) - began)


def _has_more(session: Session, phases: int) -> bool:
    """Return True if there are more phases, and all streams have come past the last one's end."""
    ends = session.segments["end_ns"]
    times = [stream.t_ns for stream in session.streams.values()]
    return len(ends) > phases and all(t.max(initial=0) > ends[-1] + LATE * SECOND_NS for t in times)


def _run(session: Path, pipe: Connection) -> None:
    # Ctrl-C is handled by the command, which ends this process.
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(19)
    look(session, pipe)
