"""Main loop of `tactile live`: predicts the force of each frame, and summarises.

Only the newest frame is used; frames that arrive during a prediction are skipped and counted.
Latency is from a frame's arrival in this computer to its force.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TextIO

import numpy as np

from recorder import SessionError
from recorder.store import decode_jpeg
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError
from rig.monitor.comparison import ComparisonPage, cells_of, columns_of
from rig.monitor.predictor import Predictor, Reading, Triple
from rig.monitor.watched import Watched

# Longest wait for the next frame before the time is checked again [s].
_WAIT = 0.1
_SHAPE = (480, 640, 3)
_COLUMNS = ("t_ns", "Fx_N", "Fy_N", "Fz_N", "contact", "latency_ms")
# Most forces kept for the summary; in longer sessions the rest is only in the file.
_KEEP = 1_000_000


class Stop(Protocol):
    """Stop request."""

    @property
    def requested(self) -> bool:
        """True if the end was requested."""


@dataclass(slots=True)
class Seen:
    """Results of watching a sensor."""

    frames: int = 0
    """Frames with a force."""
    skipped: int = 0
    """Frames skipped for a newer one."""
    lost: int = 0
    """Frames that the driver could not keep, or that were corrupt."""
    seconds: float = 0.0
    """Time from the first force to the last [s]."""
    latency: list[float] = field(default_factory=list)
    """Time from frame in to force out [s]."""
    shown_ns: list[int] = field(default_factory=list)
    """Times of the sensor states shown in the frames [ns]."""
    force: list[tuple[float, float, float]] = field(default_factory=list)
    """Predicted forces [N]; NaN on axes that the model does not predict."""
    first_ns: int | None = None

    def add(self, reading: Reading, t_ns: int, now_ns: int, shown_ns: int) -> float:
        """Record a force that was available at `now_ns` and return its latency [s]."""
        self.first_ns = now_ns if self.first_ns is None else self.first_ns
        self.frames += 1
        self.seconds = (now_ns - self.first_ns) / SECOND_NS
        latency = (now_ns - t_ns) / SECOND_NS
        if self.frames <= _KEEP:
            self.latency.append(latency)
            self.shown_ns.append(shown_ns)
            self.force.append(reading.force)
        return latency

    @property
    def rate_hz(self) -> float:
        """Forces per second."""
        return (self.frames - 1) / self.seconds if self.seconds > 0 else 0.0

    def lines(self, wrench: np.ndarray | None = None) -> Iterator[str]:
        """Yield the summary; given the true wrench (n, 6), with the error of the forces."""
        if not self.frames:
            yield "no force: no frame arrived after the reference frames"
            return
        yield (
            f"{self.frames:,} forces in {self.seconds:.1f} s, {self.rate_hz:.1f} a second; "
            f"{self.skipped} frames skipped for newer ones, {self.lost} lost"
        )
        middle, late = (
            1e3 * float(np.quantile(self.latency, fraction)) for fraction in (0.5, 0.99)
        )
        yield (
            f"latency, frame in to force out: p50 {middle:.1f} ms, p99 {late:.1f} ms, worst "
            f"{1e3 * max(self.latency):.1f} ms"
        )
        if wrench is None:
            return
        apart = np.abs(np.array(self.force) - wrench[:, :3])
        text = ", ".join(
            f"{axis} {np.nanmean(here):.2f} N (of {np.nanmax(np.abs(there)):.2f})"
            for axis, here, there in zip(("Fx", "Fy", "Fz"), apart.T, wrench.T, strict=False)
            if np.isfinite(here).any()
        )
        if text:
            yield f"mean absolute error compared with the true force: {text}"


def watch(
    watched: Watched,
    predictor: Predictor,
    clock: Clock,
    stop: Stop,
    *,
    seen: Seen,
    seconds: float | None = None,
    told: Callable[[Reading, float], None] = lambda reading, latency: None,
    out: Path | None = None,
    page: ComparisonPage | None = None,
) -> None:
    """Watch until the frames end, the time is up, or a stop is requested.

    Args:
        watched: An opened sensor.
        predictor: Predicts the force of each frame.
        clock: Clock.
        stop: Checked after every frame.
        seen: Receives all results, even if an error ends the loop.
        seconds: Duration from the first force on [s]; None: until the frames end.
        told: Called with each force and its latency [s].
        out: CSV file to write; must not exist.
        page: Page to show the forces on.

    Raises:
        ConfigError: The file exists, or the predictor cannot use the frames.
        DeviceLost: The sensor fell silent.
    """
    with _recording(out, (*_COLUMNS, *columns_of(predictor))) as record:
        if watched.no_contact is not None:
            predictor.begin(watched.no_contact)
        while not stop.requested and not _enough(seen, seconds):
            samples = watched.driver.read(_WAIT)
            watched.check()
            if not samples:
                if watched.over():
                    break
                continue
            newest = samples[-1]
            try:
                reading = predictor.step(_frame(watched, newest))
            except SessionError:
                seen.lost += 1
                continue
            if reading is None:
                continue
            if seen.first_ns is None:
                watched.begin()
            else:
                seen.skipped += len(samples) - 1
            t_ns = int(newest["t_ns"])
            latency = seen.add(reading, t_ns, clock.now_ns(), watched.shown_ns(newest))
            plain = (t_ns, *reading.force, int(reading.contact), round(1e3 * latency, 3))
            record((*plain, *cells_of(reading)))
            gauge = watched.gauge()
            if page is not None:
                page.add(reading, watched.shown_ns(newest), gauge)
            told(reading, latency)
        seen.lost += watched.driver.dropped


def _enough(seen: Seen, seconds: float | None) -> bool:
    return seconds is not None and seen.seconds >= seconds


def _frame(watched: Watched, sample: dict[str, Any]) -> Any:
    """Return the input of the predictor: pixels (480, 640, 3) or counts (16, 3).

    Raises:
        SessionError: The JPEG is corrupt.
    """
    value = sample["value"]
    return decode_jpeg(value, _SHAPE) if isinstance(value, bytes) else value


@contextlib.contextmanager
def _recording(
    out: Path | None, columns: tuple[str, ...]
) -> Iterator[Callable[[tuple[Any, ...]], None]]:
    """Yield a function that appends a row to a CSV file and flushes it.

    A file without any row is removed.
    """
    if out is None:
        yield lambda row: None
        return
    rows = 0

    def append(row: tuple[Any, ...]) -> None:
        nonlocal rows
        writer.writerow(row)
        rows += 1

    try:
        file = out.open("x", newline="", encoding="utf-8", buffering=1)
    except FileExistsError:
        raise ConfigError(f"{out}: exists; allowed: a new file") from None
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error}") from error
    try:
        with file:
            writer = csv.writer(file)
            writer.writerow(columns)
            yield append
    finally:
        if not rows:
            out.unlink()


# Output line: the newest force, rewritten ten times per second on a terminal.

_ON_TERMINAL_NS, _ELSEWHERE_NS = SECOND_NS // 10, SECOND_NS
_CLEAR = "\x1b[K"


class ForceLine:
    """Prints forces at a readable rate.

    Args:
        clock: Clock.
        out: Output stream.
    """

    def __init__(self, clock: Clock, out: TextIO) -> None:
        self._clock, self._out = clock, out
        self._terminal = out.isatty()
        self._due_ns = 0
        self._open = False

    def __call__(self, reading: Reading, latency: float) -> None:
        """Show a force and its latency [s], if the line is due."""
        now_ns = self._clock.now_ns()
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + (_ON_TERMINAL_NS if self._terminal else _ELSEWHERE_NS)
        text = f"{_told(reading.force, reading.interval)} N  "
        if reading.before is not None:
            text = f"before {_told(reading.before)}  after {text}"
        text += "contact" if reading.contact else "       "
        text += f"  {1e3 * latency:5.1f} ms{'  OUTSIDE' if reading.outside else ''}"
        self._open = self._terminal
        self._out.write(f"\r{text}{_CLEAR}" if self._terminal else f"{text}\n")
        self._out.flush()

    def close(self) -> None:
        """End the line and leave it on the terminal; may be called twice."""
        if self._open:
            self._out.write("\n")
            self._out.flush()
            self._open = False


def _told(force: Triple, interval: tuple[Triple, Triple] | None = None) -> str:
    """Return the known forces [N] as text, with half-widths of their intervals."""
    shown = []
    for place, (axis, width) in enumerate(zip(("Fx", "Fy", "Fz"), (6, 6, 7), strict=True)):
        if force[place] != force[place]:
            continue
        text = f"{axis} {force[place]:+{width}.2f}"
        if interval is not None and interval[0][place] == interval[0][place]:
            text += f" +-{0.5 * (interval[1][place] - interval[0][place]):.2f}"
        shown.append(text)
    return "  ".join(shown)
