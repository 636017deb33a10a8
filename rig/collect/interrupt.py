"""Ctrl-C as a wish, not an exception: the row in progress is finished, then the arm retracts."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any


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
