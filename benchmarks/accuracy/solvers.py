"""Error, time and memory of every solver on six presses, on a GPU and on one CPU core."""

import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import partial
from typing import Any

from benchmarks.accuracy.cases import CASES, COARSER, QUICK_CASE, Case, compare, reference_of
from benchmarks.accuracy.chart import Panel, Series, save_chart
from benchmarks.accuracy.competitors import Competitor, elements_of, ladders
from benchmarks.accuracy.spent import WARM, spent_by
from benchmarks.accuracy.wording import Row, chosen, devices_of, kind_of, percent, rounded, seconds
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, GREEN, INK, ORANGE, PURPLE, RED, SKY
from recorder.processes import cores, environment
from sim.device import ready_device
from sim.errors import SceneError, SimulationDiverged
from sim.metrics import Outcome, outcome_of
from sim.scene import press

# Assumed power law of the time of a press with fineness, used to skip slow measurements.
GROWTH = 4.0
# Measurements of a case that are expected to take longer are skipped [s].
SECONDS_MAX = 20.0
# Errors of the force for which the page has the shortest time, and time for which it has the error.
GOALS, WITHIN = (0.1, 0.03, 0.01, 0.003), 1.0
# The slowest ladder, which on a CPU is measured on the sphere alone, since the other cases would
# take hours.
SLOWEST = "mpm as published"
# Colour of each ladder; the shape of the mark gives the device.
COLOURS = {
    "layer": GREEN,
    "fem": BLUE,
    "fem float64": INK,
    "tolerance": PURPLE,
    "fem even": SKY,
    "mpm": ORANGE,
    SLOWEST: RED,
}
# Ladders of a quick run.
QUICK = ("layer", "fem")


def measure(run: Run) -> dict[str, Any]:
    """Return the rows of all cases and devices, and the uncertainty of each reference.

    On a CPU each ladder has a process of its own, so that its memory is that of the press; beside
    a GPU they run at the same time.
    """
    cases = (QUICK_CASE,) if run.quick else CASES
    truths, floors = {}, {}
    for number, case in enumerate(cases):
        truths[case.name], uncertainty = reference_of(case, run.device)
        floors[case.name] = {name: rounded(value) for name, value in uncertainty.items()}
        run.progress(0.3 * (number + 1) / len(cases))
    # The slowest begins first, so that it is not left at the end.
    names = [SLOWEST, *(name for name in ladders() if name != SLOWEST)]
    climbs = [
        (case, ladder, device)
        for device in devices_of(run.device)
        for ladder in (QUICK if run.quick else names)
        for case in cases
        if device != "cpu" or ladder != SLOWEST or case.name == "sphere"
    ]
    rows: list[Row] = []
    for number, climbed in enumerate(_climbed(run, climbs, truths)):
        rows += climbed
        run.progress(0.3 + 0.7 * (number + 1) / len(climbs))
    run.spread = "single run of each"
    return {"rows": rows, "floors": floors}


def _climbed(
    run: Run, climbs: Sequence[tuple[Case, str, str]], truths: dict[str, Outcome | None]
) -> Iterator[list[Row]]:
    """Yield the rows of each ladder: on a CPU on one core each, a quarter of them at once."""
    # Spawned: Warp's state does not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(max(1, cores() // 4), mp_context=context, max_tasks_per_child=1)
    with environment(OMP_NUM_THREADS="1"), pool:
        tasks: dict[Future[list[Row]], str] = {}
        here: dict[str, partial[list[Row]]] = {}
        for case, ladder, device in climbs:
            name = f"{case.name}, {ladder}, {device}"
            work = partial(climb, case, ladder, device, truths[case.name])
            if device == "cpu" and name not in run.rows:
                tasks[pool.submit(work)] = name
            else:
                here[name] = work
        for name, work in here.items():
            yield run.once(name, work)
        for task in as_completed(tasks):
            yield run.once(tasks[task], task.result)


def climb(case: Case, ladder: str, device: str, truth: Outcome | None) -> list[Row]:
    """Return the rows of one ladder, up to the step that is expected to take too long."""
    ready_device(device)
    rows: list[Row] = []
    for one in ladders()[ladder]:
        last = rows[-1] if rows else {}
        if last.get("seconds"):
            forecast = last["seconds"] * (one.fineness / last["fineness"]) ** GROWTH
            if forecast > SECONDS_MAX:
                break
        row = {"case": case.name, "ladder": ladder, "label": one.label, "device": device}
        rows.append(row | {"fineness": one.fineness} | measured(case, one, device, truth))
    return rows


def measured(case: Case, one: Competitor, device: str, truth: Outcome | None) -> Row:
    """Measure `one` on a case in this process, with kernels compiled before."""
    try:
        one.solve(replace(case.scene, motion=press([WARM])), device)
        outcome, spent = spent_by(lambda: one.solve(case.scene, device), device)
    except SceneError as error:
        return {"note": f"rejected: {error}"}
    row: Row = {
        "seconds": rounded(spent.wall),
        "cpu_seconds": rounded(spent.cpu),
        "memory": spent.memory,
    }
    if isinstance(outcome, SimulationDiverged):
        return row | {"elements": 0, "failed": 1, "note": str(outcome)}
    row |= {"elements": elements_of(outcome), "failed": 0, "note": ""}
    if truth is not None:
        errors = compare(outcome_of(outcome), truth, case.scene.body)
        row |= {name: rounded(value) for name, value in errors.worst().items()}
    return row


# The page


def name_of(row: Row) -> str:
    """Return the solver of a row, with its settings."""
    return f"{row['ladder']} {row['label']}".strip()


def solved(rows: Sequence[Row], case: str, kind: str) -> list[Row]:
    """Return the rows of a case that have all solutions, on a CPU or a GPU."""
    return [
        row
        for row in chosen(rows, kind, case=case)
        if row.get("force_share") is not None and not row["failed"]
    ]


def least(rows: Sequence[Row], name: str, within: str, limit: float) -> Row | None:
    """Return the row with the least of one value among those whose other is within a limit."""
    some = [row for row in rows if row[within] <= limit]
    return min(some, key=lambda row: float(row[name]), default=None)


def summary(values: dict[str, Any]) -> str:
    """Return the table of the shortest times, and the sentences about one second."""
    rows = values["accuracy"]["rows"]
    lines = []
    in_time: dict[str, dict[str, float]] = {"CPU": {}, "GPU": {}}
    for case in CASES:
        for kind, errors in in_time.items():
            some = solved(rows, case.name, kind)
            if not some:
                continue
            fastest = [least(some, "seconds", "force_share", goal) for goal in GOALS]
            cells = [
                f"{seconds(row['seconds'])}, {name_of(row)}" if row else "-" for row in fastest
            ]
            exact = least(some, "force_share", "seconds", WITHIN)
            if exact:
                errors[case.title] = exact["force_share"]
            cells.append(f"{percent(exact['force_share'])}, {name_of(exact)}" if exact else "-")
            lines.append([case.title, kind, *cells])
    sphere = CASES[0].title
    sentences = [
        f"In {WITHIN:g} s on {where} a force is exact to {percent(errors[sphere])} under the "
        f"sphere; of {len(errors)} presses the hardest is `{max(errors, key=errors.__getitem__)}`, "
        f"{percent(max(errors.values()))}."
        for where, errors in zip(("one CPU core", "a GPU"), in_time.values(), strict=True)
        if sphere in errors
    ]
    head = ["press", "on", *(f"{100 * goal:g} %" for goal in GOALS), f"error in {WITHIN:g} s"]
    return (
        "**Shortest time to an error of the force, and the solver; and the smallest error in "
        f"{WITHIN:g} s.** CPU is one core. Errors are those of the worst frame and axis."
        f"\n\n{table(head, lines)}\n\n{' '.join(sentences)}"
    )


def section(values: dict[str, Any], page: Page) -> str:
    """Return the picture, the table of one press, and the columns' meaning."""
    rows, floors = values["rows"], values["floors"]
    cases = [case for case in CASES if any(row["case"] == case.name for row in rows)]
    save_chart(
        page.picture("solvers"),
        "Error of the force against time\n"
        "lines: meshes of a solver, coarse to fine; discs: one CPU core, diamonds: GPU",
        [_panel(case, rows, floors) for case in cases],
        "time [s]",
        "error of the force [%]",
    )
    return f"""## Every solver

{page.link("solvers", "Error of the force against time, for every solver and press")}

The finest of every solver, the default, and a tolerance of 5 %, on the {cases[0].title}; the JSON
file has all of them on all presses.

{_table(rows, cases[0].name)}

The paper's gel, 20 x 20 x 4 mm, is pressed 0.5, 1.0 and 1.5 mm deep; the loop goes 1 mm down and
1 mm aside; the viscous press takes 0.1 s for 1 mm and is held for 1 s. **Force**: difference along
an axis over the frame's force, or over a tenth of the largest. **Surface**, **markers**: root of
the mean square distance between points of the top, and in the image (33.9 um a pixel).
**Memory**: on a CPU the process with Python and libraries, on a GPU the arrays. **fem**
adapts its mesh, **fem even** does not; **tolerance** refines until its own estimate of the error is
met. **mpm** has two particles a cell and dimension, **as published** the lattice, contact, time
step and mass of Tacchi and GenForce.
Reference: `fem` in float64, fineness 2, tolerance 1e-5; grey: its difference from elements
{COARSER:g} times as large."""


def _table(rows: Sequence[Row], case: str) -> str:
    """Return the table of each ladder's finest step, and some more, on a case."""
    lines = []
    for ladder in COLOURS:
        steps = _by_fineness(chosen(rows, case=case, ladder=ladder))
        for name in dict.fromkeys(map(name_of, steps)):
            if name not in ("fem default", "tolerance 5 %", name_of(steps[-1])):
                continue
            on = {kind_of(row["device"]): row for row in steps if name_of(row) == name}
            first = next(iter(on.values()))
            surface, marker = first.get("surface_rms"), first.get("marker_rms")
            cells = []
            for row in (on.get("CPU", {}), on.get("GPU", {})):
                memory = f"{row['memory'] / 2**20:.0f}" if row.get("memory") else "-"
                cells += [seconds(row.get("seconds")), memory]
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


def _panel(case: Case, rows: Sequence[Row], floors: dict[str, Any]) -> Panel:
    series = []
    for ladder, colour in COLOURS.items():
        for kind, style in (("CPU", "o-"), ("GPU", "D-")):
            steps = _by_fineness(chosen(solved(rows, case.name, kind), ladder=ladder))
            points = [(row["seconds"], 100 * row["force_share"]) for row in steps]
            name = f"{ladder}, GPU" if kind == "GPU" else ladder
            series.append(Series(name, colour, style, points))
    floor = floors.get(case.name, {}).get("force_share")
    return Panel(case.title, series, math.nan if floor is None else 100 * floor)


def _by_fineness(rows: Sequence[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: float(row["fineness"]))
