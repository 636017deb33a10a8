"""Error, time and memory of every solver on six presses, on a GPU and on one CPU core."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.accuracy.cases import CASES, QUICK_CASE, Case
from benchmarks.accuracy.chart import Mark, Panel, Series, save_chart
from benchmarks.accuracy.closed_form import closed_form
from benchmarks.accuracy.competitors import Competitor, ladders
from benchmarks.accuracy.errors import compare
from benchmarks.accuracy.reference import COARSER, Reference, reference_of
from benchmarks.accuracy.spent import spent_by
from benchmarks.accuracy.wording import devices_of, kind_of, percent, rounded, seconds
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, GREEN, INK, ORANGE, PURPLE, RED, SKY, SOFT
from recorder.processes import cores, environment
from sim.device import ready_device
from sim.errors import SceneError, SimulationDiverged
from sim.metrics import outcome_of
from sim.result import WEAK, Result
from sim.scene import press

Row = dict[str, Any]

# Depth of the press that loads the kernels before a measurement [m].
WARM = 0.02e-3
# Assumed power law of the time of a press with fineness, used to skip slow measurements.
GROWTH = 4.0
# Measurements of a case that are expected to take longer are skipped [s].
SECONDS_MAX = 20.0
# Errors of the force for which the page has the shortest time, and time for which it has the error.
GOALS, WITHIN = (0.1, 0.03, 0.01, 0.003), 1.0
# Ladder of the closed-form solutions, which take no time.
CLOSED_FORM = "closed form"
# Errors of a row: of the force as a fraction, the worst frame and axis, and in the last frame; of
# the surface [m]; of the markers [px].
MEASURES = ("force_share", "force_last", "surface_rms", "surface", "marker_rms", "marker")
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
# Ladders of a quick run.
QUICK = ("layer", "fem")


def measure(run: Run) -> dict[str, Any]:
    """Return the rows of all cases and devices, and the uncertainty of each reference.

    On a CPU each ladder has a process of its own, so that its memory is that of the press; beside
    a GPU they run at the same time.
    """
    cases = (QUICK_CASE,) if run.quick else CASES
    truths: dict[str, Reference | None] = {}
    for number, case in enumerate(cases):
        truths[case.name] = reference_of(case, run.device)
        run.progress(0.3 * (number + 1) / len(cases))
    climbs = [
        (case, ladder, device)
        for device in devices_of(run.device)
        for ladder in _ladders(run.quick)
        for case in cases
        if _possible(case, ladder, device)
    ]
    rows = [row for case in cases for row in _closed_form_rows(case, truths[case.name])]
    for number, climbed in enumerate(_climbed(run, climbs, truths)):
        rows += climbed
        run.progress(0.3 + 0.7 * (number + 1) / len(climbs))
    run.spread = "single run of each"
    floors = {name: _floor(truth) for name, truth in truths.items()}
    return {"rows": rows, "floors": floors}


def _ladders(quick: bool) -> list[str]:
    """Return the names of the ladders, the slowest first, so that none is left at the end."""
    names = [name for name in ladders() if not quick or name in QUICK]
    return sorted(names, key=lambda name: name != "mpm as published")


def _possible(case: Case, ladder: str, device: str) -> bool:
    first = ladders()[ladder][0]
    if device != "cpu":
        return not first.cpu_only
    return first.cpu_cases is None or case.name in first.cpu_cases


def _climbed(
    run: Run, climbs: Sequence[tuple[Case, str, str]], truths: dict[str, Reference | None]
) -> Iterator[list[Row]]:
    """Yield the rows of each ladder: on a CPU on one core each, a quarter of them at once."""
    # Spawned: Warp's state does not survive a fork.
    context = multiprocessing.get_context("spawn")
    with (
        environment(OMP_NUM_THREADS="1"),
        ProcessPoolExecutor(
            max(1, cores() // 4), mp_context=context, max_tasks_per_child=1
        ) as pool,
    ):
        tasks: dict[Future[list[Row]], str] = {}
        for case, ladder, device in climbs:
            name = f"{case.name}, {ladder}, {device}"
            if device == "cpu" and name not in run.rows:
                tasks[pool.submit(climb, case, ladder, device, truths[case.name])] = name
        for case, ladder, device in climbs:
            name = f"{case.name}, {ladder}, {device}"
            if device != "cpu" or name in run.rows:
                yield run.once(name, partial(climb, case, ladder, device, truths[case.name]))
        for task in as_completed(tasks):
            yield run.once(tasks[task], task.result)


def climb(case: Case, ladder: str, device: str, truth: Reference | None) -> list[Row]:
    """Return the rows of one ladder, up to the step that is expected to take too long."""
    ready_device(device)
    rows: list[Row] = []
    for one in ladders()[ladder]:
        if rows and _too_long(rows[-1], one.fineness):
            break
        rows.append(measured(case, one, device, truth))
    return rows


def _too_long(last: Row, fineness: float) -> bool:
    if not last.get("seconds"):
        return False
    return bool(last["seconds"] * (fineness / last["fineness"]) ** GROWTH > SECONDS_MAX)


def measured(case: Case, one: Competitor, device: str, truth: Reference | None) -> Row:
    """Measure `one` on a case in this process, kernels compiled before, and return the row."""
    row: Row = {
        "case": case.name,
        "ladder": one.ladder,
        "label": one.label,
        "fineness": one.fineness,
        "device": device,
    }
    try:
        one.solve(replace(case.scene, motion=press([WARM])), device)
        outcome, spent = spent_by(lambda: one.solve(case.scene, device), device)
    except SceneError as error:
        return row | {"note": f"rejected: {error}"}
    failed = isinstance(outcome, SimulationDiverged)
    row |= {
        "seconds": rounded(spent.wall),
        "cpu_seconds": rounded(spent.cpu),
        "memory": spent.memory,
        "elements": 0 if isinstance(outcome, SimulationDiverged) else _elements(outcome),
        "failed": int(failed),
        "note": str(outcome) if failed else "",
    }
    if not isinstance(outcome, SimulationDiverged) and truth is not None:
        errors = compare(outcome_of(outcome), truth.outcome, case.scene.body)
        row |= {name: rounded(errors.worst()[name]) for name in MEASURES}
        row["newtons"] = [rounded(float(n)) for n in errors.force.max(axis=0)]
    return row


def _closed_form_rows(case: Case, truth: Reference | None) -> list[Row]:
    """Return the row of the formula, or none without a common formula or a reference."""
    force = closed_form(case.name, case.scene)
    if force is None or truth is None:
        return []
    size = np.linalg.norm(truth.outcome.force, axis=1)
    fraction = np.abs(force - truth.outcome.force) / np.maximum(size, WEAK * size.max())[:, None]
    row = {"case": case.name, "ladder": CLOSED_FORM, "label": "", "fineness": 0.0, "device": "none"}
    errors = {"force_share": float(fraction.max()), "force_last": float(fraction[-1].max())}
    return [row | {"seconds": 0.0, "failed": 0} | errors]


def _floor(truth: Reference | None) -> dict[str, float | None]:
    """Return the difference of the two finest meshes by error; empty: not known."""
    known = truth.uncertainty if truth is not None else {}
    return {name: rounded(known[name]) for name in MEASURES} if known else {}


def _elements(result: Result) -> int:
    """Return the number of elements, particles, or pixels."""
    record = result.record
    if "particles" in record:
        return int(record["particles"])
    mesh = record["mesh"]
    return int(mesh["elements"] if "elements" in mesh else np.prod(mesh["grid"]))


# The page


def name_of(row: Row) -> str:
    """Return the solver of a row, with its settings."""
    return f"{row['ladder']} {row['label']}".strip()


def solved(rows: Sequence[Row], case: str, kind: str) -> list[Row]:
    """Return the rows of a case that have all solutions, on a CPU or a GPU."""
    return [
        row
        for row in rows
        if row["case"] == case
        and row["device"] != "none"
        and kind_of(row["device"]) == kind
        and row.get("force_share") is not None
        and not row["failed"]
    ]


def shortest(rows: Sequence[Row], goal: float) -> Row | None:
    """Return the fastest row whose error of the force is at most `goal`."""
    return min(
        (row for row in rows if row["force_share"] <= goal),
        key=lambda row: float(row["seconds"]),
        default=None,
    )


def most_exact(rows: Sequence[Row], within: float) -> Row | None:
    """Return the row with the smallest error of the force within a time [s]."""
    return min(
        (row for row in rows if row["seconds"] <= within),
        key=lambda row: float(row["force_share"]),
        default=None,
    )


def summary(values: dict[str, Any]) -> str:
    """Return the table of the shortest times, and the sentences about one second."""
    rows = values["accuracy"]["rows"]
    lines = []
    for case in CASES:
        for kind in ("CPU", "GPU"):
            some = solved(rows, case.name, kind)
            if some:
                cells = [_cheapest(shortest(some, goal)) for goal in GOALS]
                lines.append([case.title, kind, *cells, _exact(most_exact(some, WITHIN))])
    head = ["press", "on", *(f"{100 * goal:g} %" for goal in GOALS), f"error in {WITHIN:g} s"]
    return (
        "**Shortest time to an error of the force, and the solver; and the smallest error in "
        f"{WITHIN:g} s.** CPU is one core. Errors are those of the worst frame and axis.\n\n"
        f"{table(head, lines)}\n\n{_in_one_second(rows)}"
    )


def _in_one_second(rows: Sequence[Row]) -> str:
    """Return the yield of one second, on the sphere and over all presses."""
    sentences = []
    for kind, where in (("CPU", "one CPU core"), ("GPU", "a GPU")):
        best = {case: most_exact(solved(rows, case.name, kind), WITHIN) for case in CASES}
        errors = {case: row["force_share"] for case, row in best.items() if row is not None}
        sphere = next((error for case, error in errors.items() if case.name == "sphere"), None)
        if sphere is not None:
            hardest = max(errors, key=lambda case: float(errors[case]))
            sentences.append(
                f"In {WITHIN:g} s on {where} a force is exact to {percent(sphere)} under the "
                f"sphere; of {len(errors)} presses the hardest is `{hardest.title}`, "
                f"{percent(errors[hardest])}."
            )
    return " ".join(sentences)


def _cheapest(row: Row | None) -> str:
    return "-" if row is None else f"{seconds(row['seconds'])}, {name_of(row)}"


def _exact(row: Row | None) -> str:
    return "-" if row is None else f"{percent(row['force_share'])}, {name_of(row)}"


def section(values: dict[str, Any], page: Page) -> str:
    """Return the picture, the table of one press, and the columns' meaning."""
    rows, floors = values["rows"], values["floors"]
    cases = [case for case in CASES if any(row["case"] == case.name for row in rows)]
    save_chart(
        page.picture("solvers"),
        "Error of the force against time",
        [_panel(case, rows, floors) for case in cases],
        "error of the force [%]",
        note="lines: meshes of a solver, coarse to fine; discs: one CPU core, diamonds: GPU",
    )
    return f"""## Every solver

{page.link("solvers", "Error of the force against time, for every solver and press")}

The finest of every solver, and the default, on the {cases[0].title}; the JSON file has all of them
on all presses.

{_table(rows, cases[0].name)}

The paper's gel, 20 x 20 x 4 mm, is pressed 0.5, 1.0 and 1.5 mm deep; the loop goes 1 mm down and
1 mm aside; the viscous press takes 0.1 s for 1 mm and is held for 1 s. **Force**: difference along
an axis over the frame's force, or over a tenth of the largest. **Surface**, **markers**: root of
the mean square distance between points of the top, and in the image (33.9 um a pixel).
**Memory**: on a CPU the process with Python and libraries (220 MiB), on a GPU the arrays. **fem**
adapts its mesh, **fem even** does not; **tolerance** refines until its own estimate of the error is
met. **mpm** has two particles a cell and dimension, **as published** the lattice, contact, time
step and mass of Tacchi and GenForce. **Closed forms**: Hertz and Sneddon on a half-space.
Reference: `fem` in float64, fineness 2, tolerance 1e-5; grey: its difference from elements
{COARSER:g} times as large."""


def _table(rows: Sequence[Row], case: str) -> str:
    lines = []
    order = list(COLOURS)
    names = {name_of(row): row for row in rows if row["case"] == case}
    by_fineness = sorted(
        names.values(), key=lambda row: (order.index(row["ladder"]), row["fineness"])
    )
    finest = {steps[-1].name for steps in ladders().values()}
    for name in map(name_of, by_fineness):
        if name not in {*finest, CLOSED_FORM, "fem default"}:
            continue
        same = [row for row in rows if row["case"] == case and name_of(row) == name]
        first = same[0]
        cpu, gpu = (
            next((row for row in same if kind_of(row["device"]) == kind), {})
            for kind in ("CPU", "GPU")
        )
        cells = [
            seconds(cpu.get("seconds")),
            _memory(cpu),
            seconds(gpu.get("seconds")),
            _memory(gpu),
        ]
        if first["device"] == "none":
            cells = ["0", "-", "-", "-"]
        surface, marker = first.get("surface_rms"), first.get("marker_rms")
        lines.append(
            [
                name,
                first.get("elements") or "-",
                percent(first.get("force_share")),
                "-" if surface is None else f"{1e6 * surface:.1f}",
                "-" if marker is None else f"{marker:.3f}",
                *cells,
            ]
        )
    head = ["solver", "elements", "force", "surface [um]", "markers [px]"]
    return table([*head, "CPU core", "[MiB]", "GPU", "[MiB]"], lines)


def _memory(row: Row) -> str:
    return f"{row['memory'] / 2**20:.0f}" if row.get("memory") else "-"


def _panel(case: Case, rows: Sequence[Row], floors: dict[str, Any]) -> Panel:
    series = []
    for ladder, colour in COLOURS.items():
        for gpu in (False, True):
            chosen = [
                row
                for row in rows
                if (row["case"], row["ladder"]) == (case.name, ladder)
                and (row["device"] not in ("cpu", "none")) == gpu
                and row.get("force_share") is not None
            ]
            chosen.sort(key=lambda row: float(row["fineness"]))
            points = [(row["seconds"], 100 * row["force_share"]) for row in chosen]
            if points:
                mark: Mark = "<" if ladder == CLOSED_FORM else "D" if gpu else "o"
                name = f"{ladder}, GPU" if gpu else ladder
                series.append(Series(name, colour, mark, tuple(points)))
    floor = floors.get(case.name, {}).get("force_share")
    return Panel(case.title, tuple(series), math.nan if floor is None else 100 * floor)
