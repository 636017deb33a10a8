"""Write docs/results/accuracy.md and its charts from the measurements of every device."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.sim.accuracy.campaign import CLOSED_FORM
from benchmarks.sim.accuracy.cases import CASES, Case
from benchmarks.sim.accuracy.chart import Mark, Panel, Series, save_chart
from benchmarks.sim.accuracy.reference import COARSER
from benchmarks.sim.accuracy.row import Measured, Row
from recorder.charts import BLUE, GREEN, INK, ORANGE, PURPLE, RED, SKY, SOFT
from recorder.pages import render
from sim.fem import Fem

# Colour of each ladder; the shape of the mark gives the device.
COLOURS = {
    CLOSED_FORM: SOFT,
    "layer": GREEN,
    "fem": BLUE,
    "fem float64": INK,
    "tolerance": PURPLE,
    "fem even": SKY,
    "mpm": ORANGE,
    "mpm as published": RED,
}


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart of the page."""

    file: str
    title: str
    measure: str
    """Key of `Row.mean`, or `memory`."""
    unit: float
    """Factor applied to the measure."""
    label: str


CHARTS = (
    Chart("accuracy.png", "Error of the force", "force_share", 100, "error of the force [%]"),
    Chart(
        "accuracy-surface.png",
        "Error of the surface's displacement",
        "surface_rms",
        1e6,
        "error of the surface, rms [um]",
    ),
    Chart("accuracy-markers.png", "Error of the markers", "marker_rms", 1, "markers, rms [px]"),
    Chart("accuracy-memory.png", "Memory", "memory", 1 / 2**20, "memory [MiB]"),
)
# Force errors in the first table.
GOALS = (0.1, 0.03, 0.01, 0.003)


def write_page(path: Path, folder: Path, measured: Sequence[Measured]) -> None:
    """Write the page at `path` and its charts in `images` next to it; `folder` has the files."""
    images = path.parent / "images"
    for chart in CHARTS:
        panels = [_panel(case, chart, measured) for case in _cases(measured)]
        note = "one point per mesh, finer to the right; discs: CPU, diamonds: GPU"
        save_chart(images / chart.file, chart.title, panels, chart.label, note=note)
    cases = _cases(measured)
    order = list(COLOURS)
    text = render(
        Path(__file__).with_suffix(".md"),
        folder=folder,
        measured=measured,
        cases=cases,
        missing=[case for case in CASES if case not in cases],
        goals=GOALS,
        devices=lambda case: _devices(case, measured),
        cheapest=_cheapest,
        charts=CHARTS,
        numerics=Fem(),
        coarser=COARSER,
        rows=lambda case: sorted(
            _rows(case, measured),
            key=lambda row: (order.index(row.ladder), row.device, row.fineness),
        ),
        seconds=_seconds,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _cases(measured: Sequence[Measured]) -> list[Case]:
    known = {row.case for one in measured for row in one.rows}
    return [case for case in CASES if case.name in known]


def _rows(case: Case, measured: Sequence[Measured]) -> list[Row]:
    """Return the rows of a case from all devices, with closed forms only once."""
    found: dict[tuple[str, str, str], Row] = {}
    for one in measured:
        for row in one.rows:
            if row.case == case.name:
                found.setdefault(row.key, row)
    return list(found.values())


def _panel(case: Case, chart: Chart, measured: Sequence[Measured]) -> Panel:
    rows = _rows(case, measured)
    series = []
    for ladder, colour in COLOURS.items():
        for gpu in (False, True):
            chosen = [
                row
                for row in rows
                if row.ladder == ladder and (row.device not in ("cpu", "none")) == gpu
            ]
            chosen = sorted(chosen, key=lambda row: row.fineness)
            chosen = [row for row in chosen if math.isfinite(_value(row, chart))]
            if not chosen:
                continue
            mark: Mark = "<" if ladder == CLOSED_FORM else "D" if gpu else "o"
            series.append(
                Series(
                    name=f"{ladder}, GPU" if gpu else ladder,
                    colour=colour,
                    mark=mark,
                    points=tuple((row.wall, _value(row, chart)) for row in chosen),
                    reach=tuple(_reach(row, chart) for row in chosen),
                )
            )
    bounds = [
        one.bounds[case.name].get(chart.measure, math.nan)
        for one in measured
        if case.name in one.bounds
    ]
    known = [bound * chart.unit for bound in bounds if math.isfinite(bound)]
    return Panel(case.title, tuple(series), min(known, default=math.nan))


def _value(row: Row, chart: Chart) -> float:
    if chart.measure == "memory":
        return row.memory * chart.unit if row.memory else math.nan
    return row.mean.get(chart.measure, math.nan) * chart.unit


def _reach(row: Row, chart: Chart) -> float:
    """Return the value of the worst scene if there are several."""
    if chart.measure == "memory" or row.worst == row.mean:
        return math.nan
    return row.worst.get(chart.measure, math.nan) * chart.unit


def _devices(case: Case, measured: Sequence[Measured]) -> dict[str, list[Row]]:
    """Return the rows of a case that solved it, by device."""
    found: dict[str, list[Row]] = {}
    for row in _rows(case, measured):
        if row.mean and not row.failed and row.device != "none":
            found.setdefault(row.device, []).append(row)
    return found


def _cheapest(rows: Iterable[Row], goal: float) -> str:
    good = [row for row in rows if row.mean["force_share"] <= goal]
    if not good:
        return "-"
    best = min(good, key=lambda row: row.wall)
    return f"{_seconds(best.wall)}, {best.name}"


def _seconds(value: float) -> str:
    if value == 0:
        return "0"
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"
