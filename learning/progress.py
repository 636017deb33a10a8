"""One line that says how far work is and how long it still takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TextIO

# What takes less than this [s] says nothing.
QUIET = 2.0
# Time between updates on a terminal, and between lines elsewhere [s].
REWRITE_EVERY, LINE_EVERY = 0.5, 10.0


class Progress:
    """Called with what is done and what there is to do; the first call is the beginning."""

    def __init__(
        self, what: str, stream: TextIO, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Count `what`, e.g. `frames`, and say so on `stream`."""
        self._what, self._stream, self._clock = what, stream, clock
        self._began: tuple[float, int] | None = None
        self._said = -float("inf")
        self._open = False

    def __call__(self, done: int, total: int) -> None:
        """Take note, and say it if it is time to."""
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
        """End the line. Safe twice."""
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
    """Return a time to wait, as 12 s, 3:05 min or 2:10 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02} h"
