"""Ctrl-C while a model is trained: once ends after the step in hand, twice ends at once.

SIGTERM, which queues of clusters send before they take a machine back, asks as Ctrl-C does.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self

import torch

if TYPE_CHECKING:
    from accelerate import Accelerator

EXIT_INTERRUPTED = 130
"""Exit code of a training that was asked to stop and did."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_ECHO = 1.0
"""A signal so soon after the first [s] is the same one: torchrun passes on what all have got."""


class Stop:
    """Takes signals while it is open: a context manager, of the main thread alone."""

    def __init__(
        self,
        say: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Call `say` once when the step in hand is waited for."""
        self._say, self._clock = say, clock
        self._before: dict[signal.Signals, Any] = {}
        self._since = 0.0
        self.asked = False
        """Whether no step should begin any more."""

    def agreed(self, launched: Accelerator) -> bool:
        """Return whether any process was asked: all of them must end after the same step."""
        if launched.num_processes == 1:
            return self.asked
        asked = torch.tensor(float(self.asked), device=launched.device)
        total: Any = launched.reduce(asked, reduction="sum")
        return bool(total > 0)

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {each: signal.signal(each, self._take) for each in _SIGNALS}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)
        self._before = {}

    def _take(self, number: int, frame: FrameType | None) -> None:
        now = self._clock()
        if not self.asked:
            self.asked, self._since = True, now
            self._say("stopping: the step in hand is finished and saved; again stops at once")
        elif now - self._since > _ECHO:
            raise KeyboardInterrupt
