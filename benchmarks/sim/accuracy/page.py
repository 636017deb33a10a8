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
from sim.fem.numerics import Numerics

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

_INTRO = """# Cost of accuracy

Every solver on {count} presses: its error, time and memory. Lines join the meshes of one solver,
coarse to fine; discs were measured on a CPU, diamonds on a GPU; in the grey band errors are below
the reference's accuracy. Made by `make accuracy`; measurements are in `{folder}`, one file per
device, and `python -m benchmarks accuracy --only page` draws them again.{unmeasured}

{machines}

![Error of the force against time]({images}/accuracy.png)
"""

_METHOD = """
## Method

The body is the paper's gel, 20 x 20 x 4 mm, 0.145 MPa, nu 0.45. Plain presses have frames at 0.5,
1.0 and 1.5 mm (the 18 indenters: 0.5 and 1.0), the loop goes 1 mm down and 1 mm aside, the viscous
press goes 1 mm down in 0.1 s and is held for 1 s while a branch of half the stiffness relaxes with
0.2 s. Friction, where present, is 0.5: without it the skin under an edge slides until it creases,
in one of many ways, and there is no unique solution.

- **Force**: |F - Fref| along each axis over max(|Fref| of the frame, a tenth of the largest
  |Fref|); the worst frame and axis, and the last frame.
- **Surface**: distance between the two positions of a material point of the top, interpolated by
  cubics on both meshes; rms and largest over 121 x 121 points, the worst frame; "beside" is the
  largest value outside the contact of the reference.
- **Markers**: 14 x 14 material points of the top as the paper's camera sees them: a pinhole 21.11
  mm below the surface, 35 mm lens, 36 mm film, 640 px: p = 622.2 px (x, y) / (21.11 mm + z), 33.9
  um a pixel.
- **Seconds**: wall time of the press with kernels compiled; for the 18 indenters, solved one by
  one on a CPU and in one launch on a GPU, the total over 18. **Memory**: on a CPU the peak of a
  separate process, including Python and libraries (about 220 MiB); on a GPU the peak of its arrays.
- **fem** has a mesh that adapts to the contact; its default has the fineness {default:g}.
  **tolerance** is met by error control, or by `layer` where its estimate is trusted, and its
  seconds include all attempts. **fem even** has elements of one size everywhere.
- **Reference**: {reference}; viscous motions in time steps a third as long. The grey band is its
  difference from a mesh with elements {coarser:g} times as large: smaller errors are unknown. It is
  computed once and kept in `build/accuracy`.
- **Closed forms** (half-space): Hertz, Sneddon's punch and sharp cone, Lee and Radok, Cattaneo and
  Mindlin; they take no time and are at the left edge. Tube and the 18 have no common formula.
- **mpm** has two particles per cell and dimension; **mpm as published** is the lattice, contact,
  time step and mass of Tacchi and GenForce; on a CPU the sphere alone.
"""


def write_page(path: Path, folder: Path, measured: Sequence[Measured]) -> None:
    """Write the page at `path` and its charts in `images` next to it; `folder` has the files."""
    images = path.parent / "images"
    for chart in CHARTS:
        panels = [_panel(case, chart, measured) for case in _cases(measured)]
        note = "one point per mesh, finer to the right; discs: CPU, diamonds: GPU"
        save_chart(images / chart.file, chart.title, panels, chart.label, note=note)
    machines = " ".join(
        f"{'GPU' if one.device != 'cpu' else 'CPU'}: {one.machine}." for one in measured
    )
    reference = "; ".join(dict.fromkeys(one.reference for one in measured))
    cases = _cases(measured)
    missing = [f"`{case.name}` ({case.title})" for case in CASES if case not in cases]
    unmeasured = f"\nNot measured yet: {', '.join(missing)}." if missing else ""
    lines = [
        _INTRO.format(
            folder=folder,
            count=len(cases),
            machines=machines,
            unmeasured=unmeasured,
            images="images",
        )
    ]
    lines += _goal_lines(measured)
    for chart in CHARTS[1:]:
        lines += ["", f"![{chart.title}](images/{chart.file})"]
    default = Numerics().fineness
    lines.append(_METHOD.format(reference=reference, coarser=COARSER, default=default))
    for case in cases:
        lines += _case_lines(case, measured)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


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


def _goal_lines(measured: Sequence[Measured]) -> list[str]:
    head = " | ".join(f"{100 * goal:g} %" for goal in GOALS)
    lines = [
        "Shortest time that reaches an error of the force (worst frame and axis), and the solver:",
        "",
        f"| press | device | {head} |",
        "|---|---|" + "---|" * len(GOALS),
    ]
    for case in _cases(measured):
        rows = [row for row in _rows(case, measured) if row.mean and not row.failed]
        for device in dict.fromkeys(row.device for row in rows if row.device != "none"):
            mine = [row for row in rows if row.device == device]
            cells = [_cheapest(mine, goal) for goal in GOALS]
            where = "CPU" if device == "cpu" else "GPU"
            lines.append(f"| {case.title} | {where} | {' | '.join(cells)} |")
    return lines


def _cheapest(rows: Iterable[Row], goal: float) -> str:
    good = [row for row in rows if row.mean["force_share"] <= goal]
    if not good:
        return "-"
    best = min(good, key=lambda row: row.wall)
    return f"{_seconds(best.wall)}, {best.name}"


def _case_lines(case: Case, measured: Sequence[Measured]) -> list[str]:
    several = len(case.scenes) > 1
    lines = ["", f"## {case.title[0].upper()}{case.title[1:]}", ""]
    lines += [
        "| | device | elements | seconds | CPU s | memory [MiB] | force [%] | last [%] "
        "| Fx, Fy, Fz [mN] | surface rms, largest, beside [um] | markers rms, largest [px] |",
        "|---|---|---:|---:|---:|---:|---:|---:|---|---|---|",
    ]
    order = list(COLOURS)
    rows = sorted(
        _rows(case, measured), key=lambda row: (order.index(row.ladder), row.device, row.fineness)
    )
    return lines + [_row_line(row, several=several) for row in rows]


def _row_line(row: Row, *, several: bool) -> str:
    if not row.mean:
        return f"| {row.name} | {row.device} | | | | | {_escaped(row.note)} | | | | |"
    mean, worst = row.mean, row.worst
    force = _percent(mean["force_share"])
    if several:
        force += f" (worst {_percent(worst['force_share'])})"
    failed = f"; {row.failed} without a solution" if row.failed else ""
    axes = ", ".join(f"{1e3 * value:.2g}" for value in row.axes)
    surface = ", ".join(
        _number(1e6 * mean[name], ".1f") for name in ("surface_rms", "surface", "outside")
    )
    markers = ", ".join(_number(mean[name], ".3f") for name in ("marker_rms", "marker"))
    memory = f"{row.memory / 2**20:.0f}" if row.memory else "-"
    return (
        f"| {row.name}{failed} | {row.device} | {row.elements or '-'} | {_seconds(row.wall)} "
        f"| {_seconds(row.cpu)} | {memory} | {force} | {_percent(mean['force_last'])} | {axes} "
        f"| {surface} | {markers} |"
    )


def _percent(value: float) -> str:
    return _number(100 * value, ".2f" if value < 0.1 else ".0f")


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def _seconds(value: float) -> str:
    if value == 0:
        return "0"
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
