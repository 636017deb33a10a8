"""Are tolerances met on random scenes?

The reference is extrapolated (Richardson 1911, order 2) from the answer's mesh, or
one as fine, and one `FINER` times finer. It uses the same solver, so it measures discretisation
error only; other errors are covered by `hard-cases` and `independent`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.chart import Panel, Series, save_chart
from benchmarks.accuracy.wording import Row, kind_of, percent, rounded, seconds
from benchmarks.hard_cases.random_scenes.scenes import Drawn, drawn
from benchmarks.processes import OutOfTime, rows_of, time_limit
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, INK, RED
from recorder.progress import part_of
from sim.device import ready_device
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.metrics import tolerance_of
from sim.planning import plan
from sim.result import Result, force_scale
from sim.scene import Scene
from sim.tiers import simulate
from sim.tolerance import RATIO_LEAST, elements_ratio, left_of_difference

# Number of scenes of each tolerance; `--scenes` may be lower.
SCENES = {"3 %": 200, "1 %": 60}
# In a quick run one small scene, and a tolerance that takes seconds.
QUICK_SCENES, QUICK_SCENE = {"20 %": 1}, 9
SEED = 0
# Limit of a solve [s]; that of a reference is four times as long.
SECONDS = {"CPU": 300.0, "GPU": 120.0}
# Fraction of the answers that must keep their tolerance.
LEAST = 0.95
# Element size of the answer over that of the reference.
FINER = 1.6
# Minimum fineness of the coarser mesh of a reference.
COARSEST, QUICK_COARSEST = 0.75, 0.4
# Maximum number of elements of a reference.
TRUTH_ELEMENTS_MAX = {"CPU": 600_000, "GPU": 4_000_000}


def measure(run: Run) -> dict[str, Any]:
    """Return a row for every scene of every tolerance."""
    ready_device(run.device)
    tolerances: dict[str, list[Row]] = {}
    for number, (tolerance, most) in enumerate((QUICK_SCENES if run.quick else SCENES).items()):
        first = QUICK_SCENE if run.quick else 0
        chosen = scenes(SEED, first, min(run.options.scenes or most, most), run.folder)
        coarsest = QUICK_COARSEST if run.quick else COARSEST
        compare = partial(compared, tolerance=tolerance, coarsest=coarsest, device=run.device)
        named = {f"{tolerance}: {one.name}": one for one in chosen}
        progress = part_of(run.progress, number, len(QUICK_SCENES if run.quick else SCENES))
        rows = [*rows_of(run, compare, named, progress).values()]
        tolerances[tolerance] = rows
        kept, answers = _count(rows, "kept"), _count(rows, "kept", "missed")
        if kept < LEAST * answers:
            run.failures.append(f"{tolerance} kept in {kept} of {answers} answers")
    run.seeds, run.spread = [SEED], "single run of each scene"
    return {"tolerances": tolerances}


def scenes(seed: int, first: int, count: int, folder: Path) -> list[Drawn]:
    """Return typical uses with contact of a seed, from number `first` on."""
    chosen: list[Drawn] = []
    for index in itertools.count(first):
        one = drawn(seed, index, folder)
        if one.scene is None or not one.what.startswith("sensible"):
            continue
        if one.scene.motion.depth_max > 0:
            chosen.append(one)
            if len(chosen) == count:
                break
    return chosen


def compared(one: Drawn, tolerance: str, coarsest: float, device: str) -> Row:
    """Solve a scene within a tolerance and again on finer meshes, and compare."""
    assert one.scene is not None
    limit = SECONDS[kind_of(device)]
    row: Row = {"scene": one.name, "what": one.what}
    began = time.perf_counter()
    try:
        with time_limit(limit):
            result = plan(one.scene, tolerance, device=device).run()
    except (SceneError, SimulationDiverged, OutOfTime) as error:
        outcome = {SceneError: "refused", OutOfTime: "timeout"}.get(type(error), "diverged")
        spent = rounded(time.perf_counter() - began)
        return row | {"outcome": outcome, "seconds": spent, "reported": str(error)}
    row |= {"seconds": rounded(time.perf_counter() - began), "tier": result.tier}
    row["stated_percent"] = rounded(float(result.record["error"]["percent"]))
    try:
        with time_limit(4 * limit):
            force, unsure = _truth(one.scene, result, coarsest, device)
    except (SceneError, SimulationDiverged, OutOfTime) as error:
        return row | {"outcome": "no truth", "reported": str(error)}
    scale = np.maximum(force_scale(force), 1e-12)
    error_ = float((np.abs(result.force - force).max(axis=1) / scale).max())
    return row | {
        "outcome": "kept" if error_ <= tolerance_of(tolerance).value else "missed",
        "error_percent": rounded(100 * error_),
        "reference_percent": rounded(100 * float((unsure / scale).max())),
    }


def _truth(
    scene: Scene, result: Result, coarsest: float, device: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the extrapolated force (F, 3) [N], and its uncertainty (F,) [N]."""
    most = TRUTH_ELEMENTS_MAX[kind_of(device)]
    fineness = max(coarsest, result.record["mesh"].get("fineness", coarsest))
    finest, middle = (
        simulate(scene, Fem(fineness=one, elements_max=most), device=device)
        for one in (fineness * FINER, fineness)
    )
    ratio = elements_ratio(middle, finest)
    if ratio < RATIO_LEAST:
        raise SceneError(f"reference: a mesh of more than {most} elements; allowed: fewer")
    step = (finest.force - middle.force) * left_of_difference(ratio)
    return finest.force + step, np.abs(step).max(axis=1) / 2


# The page


def _count(rows: Sequence[Row], *outcomes: str) -> int:
    return sum(row["outcome"] in outcomes for row in rows)


def section(values: dict[str, Any], page: Page) -> str:
    """Return the table of tolerances, with the picture."""
    compared = {
        tolerance: [row for row in rows if row.get("error_percent") is not None]
        for tolerance, rows in values["tolerances"].items()
    }
    _draw(page, compared)
    lines = []
    for tolerance, rows in values["tolerances"].items():
        kept, answers = _count(rows, "kept"), _count(rows, "kept", "missed")
        times = [row["seconds"] for row in rows if row["outcome"] == "kept"]
        lines.append(
            [
                tolerance,
                len(rows),
                f"{kept} of {answers} ({percent(kept / max(answers, 1))})",
                _count(rows, "no truth"),
                *(_count(rows, outcome) for outcome in ("diverged", "timeout", "refused")),
                seconds(float(np.median(times))) if times else "-",
            ]
        )
    head = ["tolerance", "scenes", "kept", "no reference", "no converged state", "out of time"]
    return f"""## Tolerances on random scenes

{page.link("tolerance", "Error of each answer against the error that it states")}

{table([*head, "refused", "median time"], lines)}

Each drawn scene is solved by `plan(scene, tolerance).run()`, and again on two finer meshes,
extrapolated, by the same solver. *Kept*: the error is within the tolerance, of the answers whose
error is known. The error that an answer states is often smaller than the tolerance:
{_exceeded(compared)} Presses without contact have no error; they are drawn at the lower left.
Without a converged state are nearly only edges that are sharp for their depth, with little friction
or none, which have no smooth solution (`tests/benchmarks/test_independent.py`)."""


def _exceeded(tolerances: dict[str, list[Row]]) -> str:
    """Return how many answers are off by more than they and the reference state."""
    rows = [row for some in tolerances.values() for row in some]
    over = [row["error_percent"] - row["stated_percent"] - row["reference_percent"] for row in rows]
    count = sum(one > 0 for one in over)
    text = f"{count} of {len(rows)} answers are off by more than they and their reference state"
    return f"{text}, the worst by {max(over):.2f} % of the force." if count else f"{text}."


def _draw(page: Page, tolerances: dict[str, list[Row]]) -> None:
    series = [
        Series(
            f"tolerance {tolerance}",
            colour,
            "o",
            # The axes have no 0.
            [(max(row["stated_percent"], 0.1), max(row["error_percent"], 0.01)) for row in rows],
        )
        for (tolerance, rows), colour in zip(tolerances.items(), (BLUE, RED), strict=False)
    ]
    stated = [x for one in series for x, _ in one.points]
    if stated:
        ends = [(least, least) for least in (min(stated), max(stated))]
        series.append(Series("as stated", INK, "-", ends))
    save_chart(
        page.picture("tolerance"),
        "Errors on random scenes",
        [Panel("", series)],
        "error that the answer states [%]",
        "error [%]",
    )
