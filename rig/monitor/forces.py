"""Main loop of `tactile live`: predicts the force of each frame, and summarises.

Only the newest frame is used; frames that arrive during a prediction are skipped and counted.
Latency is from a frame's arrival in this computer to its force.
"""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from recorder.errors import SessionError
from recorder.store import decode_jpeg, replace_file
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError
from rig.core.paced_line import PacedLine
from rig.monitor.watched import Triple, Watched

if TYPE_CHECKING:
    from rig.monitor.predictor import LiveForce, LivePredictor

# Longest wait for the next frame before the time is checked again [s].
_WAIT = 0.1
_SHAPE = (480, 640, 3)
_AXES = ("Fx", "Fy", "Fz")
# Most forces kept for the summary; in longer sessions the rest is only in the file.
_KEEP = 1_000_000


@dataclass(slots=True)
class Summary:
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
    shows_ns: list[int] = field(default_factory=list)
    """Times of the states of the sensor that the frames show [ns]."""
    force: list[tuple[float, float, float]] = field(default_factory=list)
    """Predicted forces [N]; NaN on axes that the model does not predict."""
    first_ns: int | None = None

    def add(self, reading: LiveForce, t_ns: int, now_ns: int, shows_ns: int) -> float:
        """Record a force that was available at `now_ns` and return its latency [s]."""
        self.first_ns = now_ns if self.first_ns is None else self.first_ns
        self.frames += 1
        self.seconds = (now_ns - self.first_ns) / SECOND_NS
        latency = (now_ns - t_ns) / SECOND_NS
        if self.frames <= _KEEP:
            self.latency.append(latency)
            self.shows_ns.append(shows_ns)
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
        errors = np.abs(np.array(self.force) - wrench[:, :3])
        text = ", ".join(
            f"{axis} {np.nanmean(error):.2f} N (of {np.nanmax(np.abs(true)):.2f})"
            for axis, error, true in zip(_AXES, errors.T, wrench.T, strict=False)
            if np.isfinite(error).any()
        )
        if text:
            yield f"mean absolute error compared with the true force: {text}"


def watch(
    watched: Watched,
    predictor: LivePredictor,
    clock: Clock,
    *,
    summary: Summary,
    show: Callable[[LiveForce, int, float, Triple | None], None] = lambda *_: None,
    is_over: Callable[[], bool] = lambda: False,
    seconds: float | None = None,
    out: Path | None = None,
) -> None:
    """Watch until the frames end, the time is up, or a stop is requested (`is_over`).

    The summary receives all results, even if an error ends the loop. `show` is called with each
    force, the time of the state that its frame shows [ns], its latency [s] and the gauge's newest
    force [N]. The time [s] is from the first force on; `out` is a CSV file that must not exist.
    """
    with _recording(out, predictor) as record:
        if watched.no_contact is not None:
            predictor.begin(watched.no_contact)
        while not is_over() and not (seconds is not None and summary.seconds >= seconds):
            samples = watched.driver.read(_WAIT)
            watched.check()
            if not samples:
                if watched.over():
                    break
                continue
            newest = samples[-1]
            t_ns, shows_ns = int(newest["t_ns"]), watched.shows_ns(newest)
            try:
                reading = predictor.step(_frame(newest), shows_ns)
            except SessionError:
                summary.lost += 1
                continue
            if reading is None:
                continue
            if summary.first_ns is None:
                watched.begin()
            else:
                summary.skipped += len(samples) - 1
            latency = summary.add(reading, t_ns, clock.now_ns(), shows_ns)
            record(t_ns, latency, reading)
            show(reading, shows_ns, latency, watched.gauge())
        summary.lost += watched.driver.dropped


def _frame(sample: dict[str, Any]) -> Any:
    """Return the input of the predictor: pixels (480, 640, 3) or counts (16, 3)."""
    value = sample["value"]
    return decode_jpeg(value, _SHAPE) if isinstance(value, bytes) else value


@contextlib.contextmanager
def _recording(
    out: Path | None, predictor: LivePredictor
) -> Iterator[Callable[[int, float, LiveForce], None]]:
    """Yield a function that appends a row to a CSV file at once; an empty file is removed."""
    if out is None:
        yield lambda t_ns, latency, reading: None
        return
    columns = ["t_ns", *_columns("{}"), "contact", "latency_ms"]
    if predictor.intervals is not None:
        columns += [*_columns("{}_low"), *_columns("{}_high"), "outside"]
    if predictor.has_before:
        columns += _columns("before_{}")
    rows = 0

    def append(t_ns: int, latency: float, reading: LiveForce) -> None:
        nonlocal rows
        row = [t_ns, *reading.force, int(reading.contact), round(1e3 * latency, 3)]
        if reading.interval is not None:
            low, high = reading.interval
            row += [*low, *high, int(reading.outside)]
        writer.writerow([*row, *(reading.before or ())])
        rows += 1

    try:
        file = out.open("x", newline="", encoding="utf-8", buffering=1)
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


def _columns(pattern: str) -> list[str]:
    return [f"{pattern.format(axis)}_N" for axis in _AXES]


def add_gauge(path: Path, wrench: np.ndarray) -> None:
    """Add the gauge's forces of the first rows (n, 6) [N, N m], NaN if unknown, to a CSV file."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow([*header, *_columns("gauge_{}")])
    for number, row in enumerate(rows):
        force = wrench[number, :3].tolist() if number < len(wrench) else [np.nan] * 3
        writer.writerow([*row, *("" if value != value else value for value in force)])
    replace_file(path, text.getvalue().encode())


class ForceLine:
    """Prints forces at a readable rate."""

    def __init__(self, clock: Clock, out: TextIO) -> None:
        write = partial(print, file=out, flush=True)
        self._line = PacedLine(out, SECOND_NS // 10, SECOND_NS, write)
        self._newest: dict[str, tuple[LiveForce, float]] = {}
        self.close = self._line.end
        self._clock = clock

    def __call__(self, reading: LiveForce, latency: float, name: str = "") -> None:
        """Show a force and its latency [s], if the line is due; then those of other sensors."""
        self._newest[name] = reading, latency
        if self._line.is_due(self._clock.now_ns()):
            self._line.show(*(part for one in sorted(self._newest) for part in self._parts(one)))

    def _parts(self, name: str) -> tuple[str, ...]:
        reading, latency = self._newest[name]
        # Beside another sensor there is no space for intervals.
        text = f"{_text(reading.force, None if name else reading.interval)} N"
        if reading.before is not None:
            text = f"before {_text(reading.before)}  after {text}"
        outside = "OUTSIDE" if reading.outside else ""
        contact = "contact" if reading.contact else " " * 7
        contact = "SLIPS  " if reading.slip == "gross" else contact
        return f"{name} {text}".strip(), outside, contact, f"{1e3 * latency:5.1f} ms"


def _text(force: Triple, interval: tuple[Triple, Triple] | None = None) -> str:
    """Return the forces [N] that are numbers as text, with half-widths of their intervals."""
    parts = []
    for k, (axis, width) in enumerate(zip(_AXES, (6, 6, 7), strict=True)):
        if force[k] != force[k]:
            continue
        text = f"{axis} {force[k]:+{width}.2f}"
        if interval is not None and interval[0][k] == interval[0][k]:
            text += f" +-{0.5 * (interval[1][k] - interval[0][k]):.2f}"
        parts.append(text)
    return "  ".join(parts)
