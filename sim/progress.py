"""Progress of a simulation and its remaining time, on standard error."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

# Runs shorter than this print nothing [s].
QUIET = 2.0
# Time between lines if a line cannot be rewritten [s].
LINE_EVERY = 10.0
# Share that must be done before the remaining time is estimated from it.
ESTIMATE_FROM = 0.01
# Time between two updates [s].
BLINK = 0.25


class Progress:
    """Context manager that is called with the share done and prints it while it is open.

    On a terminal one line is rewritten and wiped at the end; elsewhere a line is printed every
    10 s.
    """

    def __init__(
        self,
        name: str,
        stream: TextIO,
        *,
        kernels: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Report the progress of `name` on `stream`.

        `kernels` is the cache folder of compiled kernels: while nothing is done and new entries
        appear there, kernels are being compiled.
        """
        self._name, self._stream, self._clock = name, stream, clock
        self._kernels = kernels
        self._known = self._compiled()
        self._rewrites = stream.isatty()
        self._begun = clock()
        self._said_last = -float("inf")
        self._share = 0.0
        self._origin: tuple[float, float] | None = None
        self._width = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="progress", daemon=True)

    def __call__(self, share: float) -> None:
        """Store the share done, 0 to 1; a smaller share than before starts again."""
        if self._origin is None or share < self._share:
            self._origin = self._clock(), share
        self._share = share

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._done.set()
        self._thread.join()
        if self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()

    def line(self) -> str:
        """Return the current text."""
        now = self._clock()
        spent = now - self._begun
        if self._origin is None:
            if self._compiled() > self._known:
                return f"{self._name}: compiling kernels, once ... {spent:.0f} s"
            return f"{self._name}: {spent:.0f} s"
        since, before = self._origin
        text = f"{self._name}: {100 * self._share:.0f} %, {spent:.0f} s"
        done = self._share - before
        if done >= ESTIMATE_FROM and self._share < 1 and now > since:
            rate = done / (now - since)
            text += f", {duration((1 - self._share) / rate)} left"
        return text

    def look(self) -> None:
        """Print the text if it is due."""
        now = self._clock()
        if now - self._begun < QUIET:
            return
        if self._rewrites:
            text = self.line()
            self._stream.write("\r" + text.ljust(self._width))
            self._stream.flush()
            self._width = len(text)
        elif now - self._said_last >= LINE_EVERY:
            self._said_last = now
            self._stream.write(self.line() + "\n")
            self._stream.flush()

    def _watch(self) -> None:
        while not self._done.wait(BLINK):
            self.look()

    def _compiled(self) -> int:
        if self._kernels is None or not self._kernels.is_dir():
            return 0
        return sum(1 for _ in self._kernels.iterdir())


def duration(seconds: float) -> str:
    """Return a waiting time as 12 s, 3:05 min or 2:10 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02} h"
