"""Progress line: work done, rate and time remaining."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TextIO

# Nothing is printed in the first seconds [s].
QUIET = 2.0
# Time between updates on a terminal, and between lines elsewhere [s].
REWRITE_EVERY, LINE_EVERY = 0.5, 10.0


class Progress:
    """Progress callback: takes the counts done and in total; the first call sets the start."""

    def __init__(
        self, what: str, stream: TextIO, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Count items named `what`, e.g. `frames`, and print to `stream`."""
        self._what, self._stream, self._clock = what, stream, clock
        self._began: tuple[float, int] | None = None
        self._said = -float("inf")
        self._open = False

    def __call__(self, done: int, total: int) -> None:
        """Update the counts, and print if an update is due."""
        now = self._clock()
        if self._began is None:
            self._began = now, done
        began, before = self._began
        every = REWRITE_EVERY if self._stream.isatty() else LINE_EVERY
        if now - began >= QUIET and now - self._said >= every and done < total:
            self._said = now
            text = f"{done:,} of {total:,} {self._what}"
            if done > before:
                rate = (done - before) / (now - began)
                text += f", {rate:.0f} a second, {duration((total - done) / rate)} left"
            self._say(text)
        if done >= total:
            self.close()

    def close(self) -> None:
        """End the line. Can be called twice."""
        if self._open:
            self._stream.write("\n")
            self._stream.flush()
            self._open = False

    def _say(self, text: str) -> None:
        if self._stream.isatty():
            self._stream.write(f"\r{text:<78}")
            self._open = True
        else:
            self._stream.write(f"{text}\n")
        self._stream.flush()


def duration(seconds: float) -> str:
    """Format a duration as 12 s, 3:05 min or 2:10 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02} h"
