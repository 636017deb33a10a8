"""Progress of long work: one bar on a terminal, elsewhere a line every 10 s.

rich draws the bar. It is imported when a bar is first drawn, so that no command starts slower.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Self, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

# Nothing is shown in the first seconds [s].
QUIET = 2.0
# Time between lines, and between looks of the thread that draws [s].
LINE_EVERY, LOOK_EVERY = 10.0, 0.25
# Fraction that must be done before the remaining time is estimated from it.
ESTIMATE_FROM = 0.01

# Called with the number of items done and their total.
ReportItems = Callable[[int, int], None]


class Progress:
    """Context manager that is called with the fraction done, 0 to 1, and shows it while it is open.

    A daemon thread draws, so the elapsed time advances while the caller computes. The bar is wiped
    at the end. Standard output is not touched.
    """

    _wiped = _starts_at_once = True

    def __init__(
        self,
        name: str,
        stream: TextIO,
        *,
        kernels: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Show the progress of `name` on `stream`.

        `kernels` is the cache folder of compiled kernels: while nothing is done and new entries
        appear there, kernels are being compiled.
        """
        self.name = name
        self._stream, self._clock, self._kernels = stream, clock, kernels
        # A dumb terminal cannot move its cursor.
        self._terminal = stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
        self._begun = clock() if self._starts_at_once else math.inf
        self._compiled_before = self._compiled()
        self._said = -math.inf
        self._share = 0.0
        self._origin: tuple[float, float] | None = None
        # Time of the newest fraction: between two of them nothing is known of the rest.
        self._at = -math.inf
        self._count_down = CountDown()
        self._bar: Bar | None = None
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="progress", daemon=True)

    def __call__(self, fraction: float) -> None:
        """Store the fraction done, 0 to 1; a smaller fraction than before restarts the estimate."""
        if self._origin is None or fraction < self._share:
            self._origin, self._count_down = (self._clock(), fraction), CountDown()
        self._at = self._clock()
        self._share = fraction

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._thread.join()
        self._end_bar()

    def look(self) -> None:
        """Draw the bar, or print a line, if it is due."""
        with self._lock:
            now = self._clock()
            if now - self._begun < QUIET:
                return
            if self._terminal:
                self._draw()
            elif now - self._said >= LINE_EVERY:
                self._said = now
                self._stream.write(self.line() + "\n")
                self._stream.flush()

    def line(self) -> str:
        """Return the line printed if there is no terminal."""
        return f"{self.name}: {self._state(f'{self._spent():.0f} s')}"

    def _head(self) -> str:
        """Return the text before the bar."""
        return self.name

    def _state(self, spent: str) -> str:
        """Return the fraction done, the elapsed and the remaining time."""
        if self._origin is not None:
            return f"{100 * self._share:.0f} %, {spent}{self._left()}"
        if self._compiled() > self._compiled_before:
            return f"compiling kernels, once ... {spent}"
        return spent

    def _left(self) -> str:
        since, before = self._origin or (0.0, 0.0)
        passed, done = self._at - since, self._share - before
        if done < ESTIMATE_FROM or self._share >= 1 or passed <= 0:
            return ""
        return self._shown((1 - self._share) / done * passed)

    def _shown(self, left: float) -> str:
        return f", {duration(self._count_down(left, 1 - self._share))} left"

    def _spent(self) -> float:
        return self._clock() - self._begun

    def _draw(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bar

        if self._bar is None:
            console = Console(file=self._stream, force_terminal=True, force_interactive=True)
            # The cursor stays visible: a killed process would not show it again.
            console.show_cursor = lambda show=True: False  # type: ignore[method-assign]
            self._bar = Bar(
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TextColumn("{task.fields[state]}", markup=False),
                console=console,
                auto_refresh=False,
                transient=self._wiped,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self._bar.add_task("", total=None, state="")
            self._bar.start()
        self._bar.update(
            self._bar.task_ids[0],
            total=None if self._origin is None else 1.0,
            completed=self._share,
            description=self._head(),
            state=self._state(duration(self._spent())),
        )
        self._bar.refresh()

    def _end_bar(self) -> None:
        with self._lock:
            if self._bar is not None:
                if not self._wiped:
                    self._draw()
                self._bar.stop()
                self._bar = None
            # Nothing more is shown.
            self._begun = math.inf

    def _watch(self) -> None:
        while not self._closed.wait(LOOK_EVERY):
            self.look()

    def _compiled(self) -> int:
        if self._kernels is None or not self._kernels.is_dir():
            return 0
        return sum(1 for _ in self._kernels.iterdir())


class ItemProgress(Progress):
    """Progress that is called with the number of items done and in total, and shows their rate.

    `name` is that of the items, e.g. `frames`. Time counts from the first call. The bar ends, and
    stays on the terminal, when all items are done; a later call starts again.
    """

    _wiped = False
    _starts_at_once = False
    _done = _total = 0

    def __call__(self, done: int, total: int) -> None:  # type: ignore[override]
        """Store the counts."""
        if self._begun == math.inf:
            self._begun, self._origin = self._clock(), None
        self._done, self._total = done, total
        super().__call__(done / total if total else 1.0)
        if done >= total:
            self._end_bar()

    def line(self) -> str:
        """Return the line printed if there is no terminal."""
        return self._head() + self._left()

    def _head(self) -> str:
        text = f"{self._done:,} of {self._total:,} {self.name}"
        rate = self._rate()
        if not rate:
            return text
        return f"{text}, {rate:.0f} a second" if rate >= 1 else f"{text}, {1 / rate:.0f} s each"

    def _left(self) -> str:
        rate = self._rate()
        left = self._total - self._done
        return self._shown(left / rate) if rate and left else ""

    def _rate(self) -> float:
        """Return the items per second since the first call; 0: unknown."""
        since, before = self._origin or (0.0, 0.0)
        passed = self._clock() - since
        return (self._done - round(before * self._total)) / passed if passed > 0 else 0.0


class CountDown:
    """The time left, as it is shown: it falls, whatever becomes of its estimate.

    Where the estimate is larger than the shown one, that falls as the work left does, so that both
    end together. An estimate that is larger by a quarter is shown as it is.
    """

    def __init__(self) -> None:
        # Time left [s] and work left.
        self._shown = math.inf, math.inf

    def __call__(self, estimate: float, work: float) -> float:
        """Return the time left [s] by an estimate [s], and by the work left in any unit."""
        shown, before = self._shown
        if shown < estimate < 1.25 * shown + 1:
            estimate = shown * min(work / before, 1.0) if before else shown
        self._shown = estimate, work
        return estimate


def span_of(
    progress: Callable[[float], None], before: float, part: float, whole: float = 1.0
) -> Callable[[float], None]:
    """Return a callback from the fraction of a `part`, behind `before`, to that of the `whole`."""
    return lambda fraction: progress((before + part * fraction) / whole)


def part_of(progress: Callable[[float], None], index: int, count: int) -> Callable[[float], None]:
    """Return a callback that converts the fraction of one of `count` equal parts."""
    return span_of(progress, index, 1, count)


def duration(seconds: float) -> str:
    """Format a duration [s] as 12 s, 3:05 min or 2:10 h."""
    whole = max(round(seconds), 0)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02} h"
