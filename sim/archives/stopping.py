"""Ctrl-C while an archive is made: once ends after the units in flight, twice ends at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self


class Stop:
    """Takes Ctrl-C while it is open: a context manager, of the main thread alone."""

    def __init__(self, say: Callable[[str], None] = lambda line: None) -> None:
        """Call `say` once when units in flight are waited for."""
        self._say = say
        self._before: Any = None
        self.asked = False
        """Whether no unit should begin any more."""

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._take)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        self._say("stopping: the units in flight are finished first; Ctrl-C again stops at once")
