"""Parts `paper` and `paper-fine`: the paper's indenters, deep in three gels."""

import time
from functools import partial
from typing import Any

import numpy as np

from benchmarks.accuracy.wording import percent
from benchmarks.hard_cases.random_scenes.scenes import PAPER_GELS
from benchmarks.processes import OutOfTime, rows_of, time_limit
from benchmarks.report import Page, Run, table
from sim.device import ready_device
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import NAMES, named
from sim.scene import Body, Effects, Friction, Scene, press
from sim.tiers import simulate

# Coefficients of friction, 0 for none; depth over thickness, and shear [m].
FRICTIONS, DEPTH, SHEAR = (0.0, 0.5, 0.9), 0.3, 1e-3
# Longest time of a press [s], and presses that must be answered: at the default, and finer.
SECONDS, LEAST = 240.0, {"default": 162, "fineness 1": 150}
# Largest median of the stated errors at the default [%].
MEDIAN = 5.0
Row = dict[str, Any]


def scenes() -> dict[str, Scene]:
    """Return the presses by name."""
    return {
        f"{name}, {1e3 * thickness:g} mm, friction {friction:g}": Scene(
            named(name),
            press([DEPTH * thickness], shear=SHEAR),
            Body(thickness=thickness, poisson=poisson),
            Effects(friction=Friction(friction)) if friction else Effects(),
        )
        for friction in FRICTIONS
        for thickness, poisson in PAPER_GELS.items()
        for name in NAMES
    }


def measure(fineness: str, run: Run) -> dict[str, Any]:
    """Solve the presses with elements of a key of `LEAST`; in a quick run one."""
    chosen = dict(list(scenes().items())[: 1 if run.quick else None])
    numerics = Fem() if fineness == "default" else Fem(fineness=1.0)
    numerics = Fem(fineness=0.2) if run.quick else numerics
    began = time.perf_counter()
    rows = rows_of(run, partial(_solved, numerics, run.device), chosen)
    spent = round(time.perf_counter() - began, 1)
    stated = [row["stated"] for row in rows.values() if row.get("stated") is not None]
    if run.quick:
        return {"fineness": fineness, "seconds": spent, "rows": rows}
    if len(stated) < LEAST[fineness]:
        run.failures.append(f"{len(stated)} answered; required: {LEAST[fineness]}")
    if fineness == "default" and (median := np.median(stated or [np.inf])) > MEDIAN:
        run.failures.append(f"stated error {median:.3g} % in the median; required: {MEDIAN:g} %")
    return {"fineness": fineness, "seconds": spent, "rows": rows}


def _solved(numerics: Fem, device: str, scene: Scene) -> Row:
    ready_device(device)
    began = time.perf_counter()
    try:
        with time_limit(SECONDS):
            error = simulate(scene, numerics, device=device).record["error"]
        row = {"stated": error.get("percent"), "why": error.get("why", "")}
    except (SceneError, SimulationDiverged, OutOfTime) as error:
        if isinstance(error, SimulationDiverged):
            error.forget_dump()
        row = {"stated": None, "why": str(error).partition("\n")[0]}
    return row | {"seconds": round(time.perf_counter() - began, 1)}


def section(values: dict[str, Any], _page: Page) -> str:
    """Return the table of indenters, and the presses without an answer."""
    lines, missing = [], []
    for name in NAMES:
        some = {key: row for key, row in values["rows"].items() if key.startswith(f"{name},")}
        stated = [row["stated"] for row in some.values() if row["stated"] is not None]
        missing += [[key, row["why"][:160]] for key, row in some.items() if row["stated"] is None]
        if some:
            errors = [percent(of(stated) / 100) if stated else "-" for of in (np.median, max)]
            longest = f"{max(row['seconds'] for row in some.values()):.0f} s"
            lines.append([name, f"{len(stated)} of {len(some)}", *errors, longest])
    rows = [row for row in values["rows"].values() if row["stated"] is not None]
    median = f"{np.median([row['stated'] for row in rows]):.2g} %" if rows else "none"
    text = f"""## The paper's indenters, deep and sheared: {values["fineness"]}

All in gels of 2.5, 4 and 5.5 mm (Poisson's ratio 0.48, 0.45, 0.40) with friction 0, 0.5 and 0.9,
pressed to {100 * DEPTH:g} % of the thickness and sheared by {1e3 * SHEAR:g} mm: {len(rows)} of
{len(values["rows"])} are answered, with {median} stated in the median, in
{values["seconds"]:.0f} s together.

{table(["indenter", "answered", "stated, median", "largest", "longest"], lines)}"""
    return text + ("\n\n" + table(["no answer", "why"], missing) if missing else "")
