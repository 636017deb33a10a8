"""What the operator wants of a running collection, whoever passes it on: pedal, page, keyboard."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

logger = logging.getLogger(__name__)

# Ctrl-C as a wish, not an exception: the row in progress is finished, then the arm retracts.


class Interrupted(Exception):
    """The operator asked to stop."""


class InterruptFlag:
    """Catches SIGINT and SIGTERM while active, as a context manager.

    The first sets `requested`; a second raises KeyboardInterrupt at once, for whoever cannot wait,
    until `ignore` is called.
    """

    def __init__(self) -> None:
        self.requested = False
        self._ignored = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> InterruptFlag:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.requested and not self._ignored:
            raise KeyboardInterrupt
        self.requested = True

    def ignore(self) -> None:
        """From now on nothing interrupts: the arm retracts, the session is being closed."""
        self._ignored = True

    def check(self) -> None:
        """Raise `Interrupted` when a stop was asked for."""
        if self.requested:
            raise Interrupted("interrupted by the operator")


class Control:
    """Pause, resume and abort. Any thread may ask; the thread that walks the plan obeys.

    A pause takes effect before the next target, with the tip clear of the surface; an abort ends
    the collection as Ctrl-C does: the phase in progress is finished, the arm retracts, all is kept.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._paused_by: set[str] = set()
        self._aborted_by: str | None = None

    def pause(self, who: str) -> None:
        """Ask to wait before the next target."""
        with self._lock:
            if who not in self._paused_by:
                logger.info("pause asked for by the %s", who)
            self._paused_by.add(who)

    def resume(self, who: str) -> None:
        """Withdraw the pause that `who` asked for; others' pauses stay."""
        with self._lock:
            if who in self._paused_by:
                logger.info("resumed by the %s", who)
            self._paused_by.discard(who)

    def abort(self, who: str) -> None:
        """Ask to end the collection; cannot be withdrawn."""
        with self._lock:
            if self._aborted_by is None:
                logger.info("abort asked for by the %s", who)
                self._aborted_by = who

    @property
    def paused_by(self) -> tuple[str, ...]:
        """Who wants a pause, in alphabetical order; empty: go on."""
        with self._lock:
            return tuple(sorted(self._paused_by))

    def check(self) -> None:
        """Raise `Interrupted` when an abort was asked for."""
        with self._lock:
            if self._aborted_by is not None:
                raise Interrupted(f"aborted by the {self._aborted_by}")


class Onlooker(Protocol):
    """Who is shown a running collection and may ask to pause or end it, as the page to watch on."""

    def begin(
        self,
        control: Control,
        progress: Callable[[], Mapping[str, Any]],
        session: Path,
        first: int,
    ) -> None:
        """Show a collection in progress.

        Args:
            control: Gets what the onlooker asks for.
            progress: Tells how far it is; may be called in any thread.
            session: Its session.
            first: First target of this run.
        """

    def say(self, status: str, reason: str = "") -> None:
        """Show a status."""
