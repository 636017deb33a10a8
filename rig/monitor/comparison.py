"""Forces before and after a transfer, beside the gauge: a page for a browser, and table columns.

The page is a file that is written again once per second and reloads itself: nothing listens on the
network. It shows the last seconds; the last version stays.
"""

from __future__ import annotations

import csv
import io
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recorder.store import replace_file
from rig.core.clock import SECOND_NS, Clock
from rig.monitor.predictor import Predictor, Reading, Triple

AXES = ("Fx", "Fy", "Fz")
# Time that the page shows [s], and between two versions of it [ns].
SHOWN_S, _EVERY_NS = 20.0, SECOND_NS
_MOST = 4000

# Names of the columns of forces, by what they are.
LOW, HIGH, BEFORE, GAUGE = (
    tuple(f"{name}_N" for name in names)
    for names in (
        [f"{axis}_low" for axis in AXES],
        [f"{axis}_high" for axis in AXES],
        [f"before_{axis}" for axis in AXES],
        [f"gauge_{axis}" for axis in AXES],
    )
)


def columns_of(predictor: Predictor) -> tuple[str, ...]:
    """Return the columns that a predictor adds to the table of forces."""
    added: tuple[str, ...] = (*LOW, *HIGH, "outside") if predictor.has_intervals else ()
    return (*added, *BEFORE) if predictor.has_before else added


def cells_of(reading: Reading) -> tuple[float | int, ...]:
    """Return the values of these columns."""
    cells: tuple[float | int, ...] = ()
    if reading.interval is not None:
        low, high = reading.interval
        cells = (*low, *high, int(reading.outside))
    return cells if reading.before is None else (*cells, *reading.before)


def add_gauge(path: Path, wrench: np.ndarray) -> None:
    """Add the gauge's forces to a table of forces, row by row.

    Args:
        path: CSV file.
        wrench: Wrenches of its first rows (n, 6) [N, N m]; NaN where unknown.
    """
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow([*header, *GAUGE])
    for number, row in enumerate(rows):
        known = wrench[number, :3].tolist() if number < len(wrench) else [np.nan] * 3
        writer.writerow([*row, *("" if value != value else value for value in known)])
    replace_file(path, text.getvalue().encode())


@dataclass(frozen=True, slots=True)
class _Point:
    t_ns: int
    reading: Reading
    gauge: Triple | None


class ComparisonPage:
    """The page of a live comparison.

    Args:
        path: HTML file to write.
        clock: Clock.
        sensor: Name of the sensor.
    """

    def __init__(self, path: Path, clock: Clock, sensor: str) -> None:
        self._path, self._clock, self._sensor = path, clock, sensor
        self._points: deque[_Point] = deque(maxlen=_MOST)
        self._due_ns = 0

    def add(self, reading: Reading, t_ns: int, gauge: Triple | None = None) -> None:
        """Add the forces of a frame that shows the sensor at a time [ns].

        Args:
            reading: Predicted forces.
            t_ns: The time.
            gauge: The gauge's newest force [N]; None if there is none.
        """
        self._points.append(_Point(t_ns, reading, gauge))
        now_ns = self._clock.now_ns()
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + _EVERY_NS
            self._write(reloads=True)

    def finish(self, wrench: Callable[[np.ndarray], np.ndarray] | None) -> None:
        """Write the last version, with the true forces if they are only known now."""
        if not self._points:
            return
        if wrench is not None:
            true = wrench(np.array([point.t_ns for point in self._points], np.int64))[:, :3]
            self._points = deque(
                _Point(point.t_ns, point.reading, (float(row[0]), float(row[1]), float(row[2])))
                for point, row in zip(self._points, true, strict=True)
            )
        self._write(reloads=False)

    def _write(self, *, reloads: bool) -> None:
        last_ns = self._points[-1].t_ns
        points = [p for p in self._points if last_ns - p.t_ns <= SHOWN_S * SECOND_NS]
        times = np.array([(p.t_ns - last_ns) / SECOND_NS for p in points])
        refresh = '<meta http-equiv="refresh" content="1">' if reloads else ""
        plots = "".join(_plot(axis, times, points) for axis in range(3))
        newest = points[-1].reading
        state = "outside of what was learned" if newest.outside else ""
        page = _PAGE.format(refresh=refresh, sensor=self._sensor, plots=plots, state=state)
        replace_file(self._path, page.encode())


# A plot of one axis as SVG.

_WIDTH, _HEIGHT, _LEFT = 900, 190, 60
_COLOURS = {"before": "#d55e00", "after": "#0072b2", "gauge": "#262a33"}


def _plot(axis: int, times: np.ndarray, points: Sequence[_Point]) -> str:
    """Return the plot of an axis, or nothing if no force on it is known."""
    nan = (np.nan,) * 3
    curves = {
        "before": np.array([(p.reading.before or nan)[axis] for p in points]),
        "after": np.array([p.reading.force[axis] for p in points]),
        "gauge": np.array([(p.gauge or nan)[axis] for p in points]),
    }
    low, high = (
        np.array([(p.reading.interval or (nan, nan))[end][axis] for p in points]) for end in (0, 1)
    )
    every = np.concatenate([*curves.values(), low, high])
    if not np.isfinite(every).any():
        return ""
    bottom, top = float(np.nanmin(every)), float(np.nanmax(every))
    margin = max(0.05 * (top - bottom), 0.05)
    bottom, top = bottom - margin, top + margin

    def place(value: float, time: float) -> str:
        across = _LEFT + (_WIDTH - _LEFT) * (1.0 + time / SHOWN_S)
        return f"{across:.1f},{_HEIGHT * (top - value) / (top - bottom):.1f}"

    drawn = []
    known = np.isfinite(low) & np.isfinite(high)
    if known.any():
        band = [place(v, t) for v, t in zip(high[known], times[known], strict=True)]
        band += [place(v, t) for v, t in zip(low[known][::-1], times[known][::-1], strict=True)]
        drawn.append(f'<polygon points="{" ".join(band)}" fill="#0072b2" opacity="0.18"/>')
    for name, values in curves.items():
        known = np.isfinite(values)
        if known.any():
            line = " ".join(place(v, t) for v, t in zip(values[known], times[known], strict=True))
            drawn.append(
                f'<polyline points="{line}" fill="none" stroke="{_COLOURS[name]}" '
                f'stroke-width="{3 if name == "gauge" else 1.5}"/>'
            )
    told = "  ".join(
        f'<tspan fill="{_COLOURS[name]}">{name} {values[-1]:+.2f}</tspan>'
        for name, values in curves.items()
        if np.isfinite(values[-1])
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT + 24}"><text x="0" y="16">{AXES[axis]} [N]</text>'
        f'<text x="{_LEFT}" y="{_HEIGHT + 18}" xml:space="preserve">{told}</text>'
        f'<text x="0" y="{_HEIGHT}">{bottom:.1f}</text><text x="0" y="34">{top:.1f}</text>'
        f"{''.join(drawn)}</svg>\n"
    )


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">{refresh}<title>{sensor}: forces</title><style>
body {{ font: 15px/1.4 system-ui, sans-serif; color: #262a33; max-width: 960px; margin: 1em auto; }}
svg {{ width: 100%; border-bottom: 1px solid #e2e5ea; }} b {{ color: #d55e00; }}
</style></head><body>
<p>{sensor}: forces before (the source's model) and after the transfer, with 90 % intervals, beside
the gauge. The last 20 s. <b>{state}</b></p>
{plots}</body></html>
"""
