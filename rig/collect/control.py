"""What the operator wants of a running collection, whoever passes it on: pedal, page, keyboard."""

from __future__ import annotations

import logging
import threading

from rig.collect.interrupt import Interrupted

logger = logging.getLogger(__name__)


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
