"""Write docs/results/speed.md.

Numbers come from the measurements of every device, or are cited.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from benchmarks.sim.speed.campaign import (
    AUGMENTATIONS,
    PATH_TOLERANCE,
    REFERENCE_FILE,
    TOLERANCE,
    presses_file,
)
from benchmarks.sim.speed.candidates import (
    Candidate,
    cheapest,
    offer_table,
    offers_of,
    save_offer_chart,
)
from benchmarks.sim.speed.cells import MISSING, memory, or_missing, percent, row, seconds
from benchmarks.sim.speed.forces import SHALLOW_MM, Errors, errors, read_forces
from benchmarks.sim.speed.record import Run, SpeedRecord
from benchmarks.sim.speed.step_tables import floor_section, steps_section
from benchmarks.sim.speed.tacchi import CITED, SOURCE
from benchmarks.sim.speed.work import DENSE_X, DENSE_Y
from sim.extrapolation import left_of_difference
from sim.fem.numerics import FOR_EDGES
from sim.paper_presses import DEPTHS_MM, FRICTION, PLACES_MM

# Goals for total seconds and force error, by kind of device: required, and stretch goals.
GOALS = {"cpu": ((600.0, 0.03), (300.0, 0.01)), "gpu": ((10.0, 0.01), (3.0, 0.01))}
WHOLE, DENSE = 162, 810
# Chart, in the folder `images` next to the page.
CHART = "speed.png"

_INTRO = """# Speed

The paper's work: 18 indenters at 9 places ({places} mm along x and y), pressed to {depths} mm, with
friction {friction:g}, into its gel of 20 x 20 x 4 mm. {whole} presses, 5 frames each, by the `fem`
tier with the element height given in the table. Elements are {finer:g} times as wide at the
indenter and grow outwards. Tolerances match these meshes (`Fem(tolerance={tolerance:g},
path_tolerance={path:g}, augmentations={augmentations})`). Seconds are wall time from scenes to
results, with kernels compiled; compile time is given separately. Shared machines vary from day to
day: the rates of each, measured next to its presses, are under "Roofline bound", and material
points were timed in the same run. Made by `make speed`.
"""
_ERRORS = """
Error: |F - Fref| / |Fref| of every press and depth in the reference: all 18 indenters in the
middle, at a corner and at a side.
"""
_MESHES = """
## Cost of accuracy

The same {whole} presses with coarser and finer elements, and with two meshes whose forces are
extrapolated to zero element size (`simulate(..., Extrapolated(...))`, `--extrapolate`); errors
from {deep:g} mm on. Errors of a mesh fall about as the square of its elements' size, and all forces
are too large. By that law the reference is still about {left} too large, which affects every
row: a mesh is worse by this amount, and two meshes are better than shown.

![Error against seconds, of a mesh and of two](images/{chart})
"""
_SCALING = """
## More presses

The 1 and the 9 presses are spread over indenters and places; {dense} are the indenters
on {x} x {y} places.
"""
_MPM = """
## Material points

Our own `mpm` tier on the sphere in the middle, timed in the same run. "{whole} presses" is that
press {whole} times, or the batch repeated: a prediction.
"""
_TACCHI = """
## Tacchi

The authors' program on the same 162 presses, cited: {source}.

| way | one press, 2 CPU cores | 162 presses, 2 CPU cores | 162 presses, one H200 |
|---|---|---|---|
"""
_COMMANDS = """
## Measured with

```
make speed                                   # this machine's CPU, then this page
python -m benchmarks speed --device cuda:0 --only presses,scaling,steps,mpm,meshes,reference \\
  --out DIR
python -m benchmarks speed --only page       # with DIR's files next to those in docs/results/speed
```

Runs in `{folder}` are not measured again unless `--again` is given; `--long` also measures all
{dense} on a CPU.
"""


def write_page(path: Path, records: Sequence[SpeedRecord]) -> None:
    """Write the page at `path` from the records of one folder."""
    folder = records[0].path.parent
    reference = read_forces(folder / REFERENCE_FILE)
    places = ", ".join(f"{place:g}" for place in PLACES_MM)
    depths = ", ".join(f"{depth:g}" for depth in DEPTHS_MM)
    finer = FOR_EDGES.finer
    lines = [
        _INTRO.format(
            places=places,
            depths=depths,
            friction=FRICTION,
            whole=WHOLE,
            finer=finer,
            tolerance=TOLERANCE,
            path=PATH_TOLERANCE,
            augmentations=AUGMENTATIONS,
        )
    ]
    found = [
        (errors(forces, reference, from_mm=SHALLOW_MM), errors(forces, reference))
        for forces in (read_forces(presses_file(record.path)) for record in records)
    ]
    candidates = [offers_of(record, reference) for record in records]
    lines += _headline(records, found, candidates)
    lines += _machine_lines(records)
    lines += [_ERRORS + _reference_text(records)]
    lines += _error_table(records, found)
    left = _left_in_reference(records, candidates)
    save_offer_chart(path.parent / "images" / CHART, records, candidates, left)
    lines += [
        _MESHES.format(whole=WHOLE, deep=SHALLOW_MM, left=percent(left), chart=CHART),
        *offer_table(records, candidates),
    ]
    lines += [_SCALING.format(dense=DENSE, x=DENSE_X, y=DENSE_Y)]
    lines += _scaling_table(records)
    lines += steps_section(records, reference)
    lines += floor_section(records)
    lines += [_MPM.format(whole=WHOLE), *_mpm_table(records)]
    lines.append(_TACCHI.format(source=SOURCE).rstrip("\n"))
    lines += [f"| {one.name} | {one.press} | {one.cpu} | {one.gpu or 'not run'} |" for one in CITED]
    lines.append(_COMMANDS.format(folder=folder, dense=DENSE))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines), encoding="utf-8")


def _headline(
    records: Sequence[SpeedRecord],
    found: Sequence[tuple[Errors, Errors]],
    candidates: Sequence[Sequence[Candidate]],
) -> list[str]:
    lines = [
        f"| machine | elements | {WHOLE} presses | a press | without a solution | error, mean | "
        "memory | goal | reached | stretch goal | reached |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for record, (deep, _all), some in zip(records, found, candidates, strict=True):
        run = record.get("presses", "all") or Run("presses", "all")
        goals = GOALS["cpu" if record.machine.device == "cpu" else "gpu"]
        cells = [
            _where(record, run),
            or_missing(run.spacing_mm, f"{run.spacing_mm:.3g} mm"),
            seconds(run.best) + ("" if run.presses in (0, WHOLE) else f" ({run.presses} presses)"),
            _per_press(run),
            str(run.failed) if run.presses else MISSING,
            percent(deep.mean),
            memory(run.memory),
        ]
        for limit, error in goals:
            cells.append(f"{seconds(limit)}, {100 * error:g} %")
            cells.append(_reached(some, limit, error))
        lines.append(row(cells))
    return lines


def _reached(candidates: Sequence[Candidate], limit: float, error: float) -> str:
    """Return whether a goal was reached and by which mesh, or the nearest result."""
    whole = [one for one in candidates if one.presses >= WHOLE and math.isfinite(one.errors.mean)]
    if not whole:
        return MISSING
    best = cheapest(whole, error)
    if best is None:
        near = min(whole, key=lambda one: one.errors.mean)
        failed = f", {near.failed} without a solution" if near.failed else ""
        return f"no: {percent(near.errors.mean)} at best ({near.elements}{failed})"
    answer = "yes" if best.seconds <= limit else "no"
    return f"{answer}: {seconds(best.seconds)}, {percent(best.errors.mean)} ({best.elements})"


def _machine_lines(records: Sequence[SpeedRecord]) -> list[str]:
    lines = [""]
    for record in records:
        machine, run = record.machine, record.get("presses", "all")
        if math.isfinite(machine.warm_seconds):
            compiled = f"{machine.compiled} kernel modules compiled and loaded"
            text = f"{machine.name}: first presses {seconds(machine.warm_seconds)} ({compiled})"
            if run is not None and math.isfinite(run.again):
                text += f"; all presses {seconds(run.seconds)}, then {seconds(run.again)} again"
            if run is not None and math.isfinite(run.tolerance) and run.tolerance != TOLERANCE:
                text += (
                    f"; measured at a tolerance of {run.tolerance:g}, before it was {TOLERANCE:g}"
                )
            lines.append(f"- {text}.")
    return lines


def _reference_text(records: Sequence[SpeedRecord]) -> str:
    for record in records:
        run = record.get("reference", "reference")
        if run is not None:
            return (
                f"Reference: {run.presses} presses with elements {run.spacing_mm:.3g} mm high, "
                f"{run.note}, {seconds(run.seconds)} on {record.machine.name}."
            )
    return f"Reference: {MISSING}."


def _left_in_reference(
    records: Sequence[SpeedRecord], candidates: Sequence[Sequence[Candidate]]
) -> float:
    """Return the mean error of the reference, by the law of `sim.extrapolation`."""
    run = next((found for each in records if (found := each.get("reference", "reference"))), None)
    finest = min(
        (
            one
            for each, some in zip(records, candidates, strict=True)
            if each.machine.device != "cpu"
            for one in some
            if one.coarser_mm is None and math.isfinite(one.errors.mean)
        ),
        key=lambda one: one.spacing_mm,
        default=None,
    )
    if run is None or finest is None:
        return math.nan
    return finest.errors.mean * left_of_difference(finest.spacing_mm / run.spacing_mm)


def _error_table(
    records: Sequence[SpeedRecord], found: Sequence[tuple[Errors, Errors]]
) -> list[str]:
    lines = [
        "",
        "| machine | depths | presses | mean | 95 % below | worst | where | mean of Fz alone |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for record, both in zip(records, found, strict=True):
        for depths, one in zip((f"from {SHALLOW_MM:g} mm on", "all"), both, strict=True):
            cells = [record.machine.name, depths, str(one.presses or MISSING)]
            cells += [percent(value) for value in (one.mean, one.most, one.worst)]
            cells += [one.worst_at or "-", percent(one.normal)]
            lines.append(row(cells))
    return lines


def _scaling_table(records: Sequence[SpeedRecord]) -> list[str]:
    lines = [
        "| machine | presses | processes | seconds | ms a press | memory |",
        "|---|---|---|---|---|---|",
    ]
    for record in records:
        whole = record.get("presses", "all")
        for count in (1, 9, WHOLE, DENSE):
            run = whole if count == WHOLE else record.get("scaling", str(count))
            predicted = ""
            if count == DENSE and run is None and whole is not None and whole.presses:
                run = Run(
                    "scaling",
                    str(DENSE),
                    presses=DENSE,
                    seconds=whole.best / whole.presses * DENSE,
                    processes=whole.processes,
                )
                predicted = f" (predicted from {whole.presses})"
            cells = [record.machine.name, str(count)]
            if run is None:
                lines.append(row([*cells, *[MISSING] * 4]))
                continue
            each = f"{1e3 * run.best / run.presses:.3g}" if run.presses else MISSING
            held = "-" if predicted else memory(run.memory)
            cells += [str(run.processes), seconds(run.best) + predicted, each, held]
            lines.append(row(cells))
    return lines


def _mpm_table(records: Sequence[SpeedRecord]) -> list[str]:
    lines = [
        f"| machine | preset | particles | time steps | seconds | a press | {WHOLE} presses | "
        f"`fem`, {WHOLE} presses |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for record in records:
        whole = record.get("presses", "all") or Run("presses", "all")
        runs = record.of("mpm")
        if not runs:
            lines.append(row([record.machine.name, *[MISSING] * 7]))
        for run in runs:
            each = run.seconds / run.presses if run.presses else math.nan
            solved = max(run.presses - run.failed, 1)
            name = run.name if not run.failed else f"{run.name} ({run.failed} without a solution)"
            # Several processes would share the presses on a CPU, as they do for `fem`.
            cores = whole.processes if record.machine.device == "cpu" else 1
            cells = [
                record.machine.name,
                name,
                f"{run.elements // solved:,}",
                f"{run.newton // solved:,}",
                seconds(run.seconds),
                seconds(each),
                f"{seconds(each * WHOLE / cores)} (predicted"
                + (f", {cores} cores)" if cores > 1 else ")"),
                seconds(whole.best),
            ]
            lines.append(row(cells))
    return lines


def _where(record: SpeedRecord, run: Run) -> str:
    processes = f", {run.processes} processes" if run.processes > 1 else ""
    return record.machine.name + processes


def _per_press(run: Run) -> str:
    return seconds(run.best / run.presses) if run.presses else MISSING
