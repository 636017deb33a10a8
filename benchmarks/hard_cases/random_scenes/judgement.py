"""Parts `random`, `cores` and `variants`: scenes answered within a time, and judged by a referee.

A scene's answer is `plan(scene, TOLERANCE, seconds=...)`. All are answered first, then each answer
is compared with its reference: an answer without one, or with one that is less certain than itself,
counts as one whose stated error does not hold.
"""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.hard_cases.laws import Array
from benchmarks.hard_cases.random_scenes.reference import NoReference, reference_of
from benchmarks.hard_cases.random_scenes.scenes import GROUPS, Drawn, drawn
from benchmarks.processes import OutOfTime, rows_of, time_limit
from benchmarks.report import Page, Run, table
from recorder.progress import span_of
from sim.device import kind_of, ready_device
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import sphere
from sim.planning import plan
from sim.result import Result, force_scale
from sim.scene import Body, Scene, press
from sim.tiers import simulate

TOLERANCE, WITHIN, MOST = "3 %", 3.0, 30.0
# Time of an answer over the one that it was given, after which there is none; and that of a
# reference [s].
LATE, REFERENCE = 1.25, 300.0
# Fraction of the scenes that must be answered, be within the tolerance, state at most `MOST`, and
# have a stated error that holds.
LEAST = {"cuda": (0.95, 0.85, 1.0, 0.97), "cpu": (0.95, 0.75, 1.0, 0.97)}
# Scenes on cores: one in this number of those on the device, from this number on.
FEWER, FIRST_ON_CORES = 5, 100_000
# Error over the stated one above which an answer is silently wrong.
SILENT = 2.0
# Negligible force, in modulus times thickness squared: 0.2 uN in the paper's gel.
NOTHING = 1e-7
# A scene that takes seconds, for all parts of a quick run.
QUICK = (17,)
Row = dict[str, Any]


def answered(scene: Scene, tolerance: str, seconds: float, device: str) -> Result:
    """Return the best answer within a time; raise `OutOfTime` if there is none."""
    with time_limit(LATE * seconds):
        return plan(scene, tolerance, seconds=seconds, device=device).run()


def answer(one: Drawn, device: str, seconds: float) -> Row:
    """Return the answer of a scene, in JSON, or why there is none."""
    ready_device(device)
    row: Row = {"scene": one.name, "what": one.what, "groups": list(one.groups)}
    began = time.perf_counter()
    try:
        result = answered(one.scene, TOLERANCE, seconds, device)
    except Exception as error:  # a crash is an answer that is missing too
        row |= {"seconds": round(time.perf_counter() - began, 1), "why": _reason(error)}
        return row
    record = result.record
    return row | {
        "seconds": round(time.perf_counter() - began, 1),
        "force": result.force.tolist(),
        "stated": record["error"].get("percent"),
        "tier": result.tier,
        "fineness": record.get("mesh", {}).get("fineness", 0.0),
        "factor": record.get("time", {}).get("factor", 1),
        "why": record.get("plan", {}).get("why", ""),
    }


def _reason(error: Exception) -> str:
    """Return why there is no answer, in one line."""
    if isinstance(error, SimulationDiverged):
        error.forget_dump()
        return f"diverged: {error.reason}"
    kinds = {SceneError: "refused", OutOfTime: "out of time"}
    return f"{kinds.get(type(error), type(error).__name__)}: {error}".partition("\n")[0]


def judged(of: tuple[Drawn, Row], device: str) -> Row:
    """Return an answer's error by the referee, in JSON, or why there is no reference."""
    one, row = of
    ready_device(device)
    began = time.perf_counter()
    try:
        with time_limit(REFERENCE):
            reference = reference_of(one.scene, row["fineness"], row["factor"], device)
    except (NoReference, OutOfTime) as error:
        return {"no_reference": str(error).partition("\n")[0]}
    except Exception as error:  # the others are still to be judged
        return {"no_reference": f"{type(error).__name__}: {error}".partition("\n")[0]}
    least = NOTHING * one.scene.body.modulus * one.scene.body.thickness**2
    verdict = compared(np.array(row["force"]), reference.force, reference.unsure, least)
    if verdict["unsure"] > max(row["stated"] or 0.0, WITHIN):
        return {"no_reference": f"uncertain by {verdict['unsure']:.3g} %: {reference.by}"}
    spent = round(time.perf_counter() - began, 1)
    return verdict | {"by": reference.by, "reference_seconds": spent}


def compared(force: Array, reference: Array, unsure: Array, least: float) -> dict[str, float]:
    """Return the largest error of a force (F, 3), its least certain part, and the uncertainty.

    All in percent of the force of a frame, of a tenth of the largest, or of `least` [N]; an error
    is that of a component, as that of a tolerance. `surely` is the error less the reference's
    uncertainty (F,), frame by frame.
    """
    scale = np.maximum(force_scale(reference), least)
    off = np.abs(force - reference).max(axis=1)
    return {
        "off": float(100 * (off / scale).max()),
        "surely": float(100 * (np.maximum(off - unsure, 0.0) / scale).max()),
        "unsure": float(100 * (unsure / scale).max()),
    }


def holds(row: Mapping[str, Any]) -> bool:
    """Return True if an answer's stated error contains its error."""
    stated = row.get("stated")
    return "surely" in row and stated is not None and row["surely"] <= stated


def within(row: Mapping[str, Any]) -> bool:
    """Return True if an answer is within the tolerance, as it states and truly."""
    return holds(row) and row["stated"] <= WITHIN * 1.001 and row["off"] <= WITHIN


def silent(row: Mapping[str, Any]) -> bool:
    """Return True if an answer is wrong by far more than it states."""
    stated = row.get("stated")
    return "surely" in row and stated is not None and row["surely"] > SILENT * stated


# The parts.


def measure(run: Run) -> list[Row]:
    """Answer and judge the random scenes on the device."""
    first, count = run.options.first, run.options.scenes
    return _random(run, QUICK if run.quick else range(first, first + count), run.device)


def measure_cores(run: Run) -> list[Row]:
    """Answer other random scenes on cores, one each, and judge them on the device."""
    first = FIRST_ON_CORES + run.options.first
    count = max(1, run.options.scenes // FEWER)
    return _random(run, QUICK if run.quick else range(first, first + count), "cpu")


def _random(run: Run, indices: Sequence[int], device: str) -> list[Row]:
    run.seeds = [run.options.seed]
    scenes = [drawn(run.options.seed, index) for index in indices]
    rows = all_judged(run, scenes, device)
    least = LEAST[kind_of(device)]
    for (name, count, whole), fraction in zip(_counts(rows), least, strict=False):
        if count < fraction * whole and not run.quick:
            run.failures.append(f"{name}: {count} of {whole}; required: {100 * fraction:g} %")
    return rows


def all_judged(run: Run, scenes: Sequence[Drawn], device: str) -> list[Row]:
    """Return the rows of scenes: first all answers, then the referee's verdicts."""
    kinds = {one.scene.effects.key: one.scene for one in scenes}
    kernels = {f"kernels: {', '.join(key)}": scene for key, scene in kinds.items()}
    rows_of(run, partial(_compiled, device), kernels, span_of(run.progress, 0.0, 0.05))
    named = {f"answer: {one.name}": one for one in scenes}
    solve = partial(answer, device=device, seconds=float(run.options.seconds))
    answers = [*rows_of(run, solve, named, span_of(run.progress, 0.05, 0.4)).values()]
    with_force = {
        f"reference: {one.name}": (one, row)
        for one, row in zip(scenes, answers, strict=True)
        if "force" in row
    }
    judge = partial(judged, device=run.device)
    verdicts = rows_of(run, judge, with_force, span_of(run.progress, 0.45, 0.55))
    rows = [row | verdicts.get(f"reference: {row['scene']}", {}) for row in answers]
    run.failures += [
        f"{row['scene']}: {row['off']:.3g} % off, {row['stated']:.3g} % stated"
        for row in rows
        if silent(row)
    ]
    return [{key: value for key, value in row.items() if key != "force"} for row in rows]


def _compiled(device: str, scene: Scene) -> bool:
    """Compile the kernels of a scene's effects, whose time is not that of an answer."""
    ready_device(device)
    small = Scene(sphere(4e-3), press([0.2e-3]), Body(8e-3, 8e-3), scene.effects)
    for precision in ("float32", "float64"):
        simulate(small, Fem(fineness=0.3, precision=precision), device=device)
    return True


def _counts(rows: Sequence[Row]) -> list[tuple[str, int, int]]:
    """Return each demand with the number of scenes that meet it, and of those it is for."""
    answers = [row for row in rows if row.get("stated") is not None]
    good = [row for row in answers if within(row)]
    others = [row["stated"] for row in answers if not within(row)]
    return [
        ("answered", len(answers), len(rows)),
        (f"within {WITHIN:g} %, stated and true", len(good), len(rows)),
        (f"others, up to {MOST:g} % stated", sum(one <= MOST for one in others), len(others)),
        ("stated error holds", sum(map(holds, answers)), len(answers)),
        ("silently wrong", sum(map(silent, answers)), len(answers)),
        ("no reference", sum("surely" not in row for row in answers), len(answers)),
    ]


# The page.


def section(title: str, rows: list[Row], _page: Page) -> str:
    """Return the counts by group, and the answers that are missing or wrong."""
    groups = {"all": rows} | {
        name: some for name in GROUPS if (some := [row for row in rows if name in row["groups"]])
    }
    lines = [[name, len(some), *_figures(some)] for name, some in groups.items()]
    head = ["scenes", "number", *(name for name, _, _ in _counts([]))]
    text = f"""## {title}

Each scene is answered by `plan(scene, "{TOLERANCE}", seconds=...)`. The referee solves it again
with finer elements, less overlap and shorter steps, or, along an axis, by the axisymmetric solver
of [independent](independent.md). A stated error holds if it contains the answer's error, but for
the reference's own uncertainty; without a reference it does not hold. *Silently wrong*: the error
is more than {SILENT:g} times the stated one.

{table([*head, "time: median, longest", "stated over true error, median"], lines)}"""
    troubles = [row for row in rows if not holds(row)]
    return f"{text}\n\n{answers(troubles)}" if troubles else text


def answers(rows: Sequence[Row]) -> str:
    """Return the table of answers: times, errors, and the reference or why there is none."""
    lines = []
    for row in rows:
        why = row.get("by") or row.get("no_reference") or row["why"]
        cells = [row["scene"], row["what"], f"{row['seconds']:.0f} s"]
        for name in ("stated", "off", "unsure"):
            cells.append("-" if row.get(name) is None else f"{row[name]:.3g} %")
        cells += ["yes" if holds(row) else "**no**", why.replace("|", "\\|")[:200]]
        lines.append(cells)
    head = ["scene", "what", "time", "stated", "error", "the reference's", "holds", "reference"]
    return table(head, lines)


def _figures(rows: Sequence[Row]) -> list[str]:
    """Return the counts, times and the ratio of stated to true errors."""
    times = [row["seconds"] for row in rows]
    ratios = [row["stated"] / max(row["off"], row["unsure"], 1e-3) for row in rows if holds(row)]
    ratio = f"{np.median(ratios):.1f}" if ratios else "-"
    spent = f"{np.median(times):.0f} s, {max(times):.0f} s"
    return [*(f"{some} of {whole}" for _, some, whole in _counts(rows)), spent, ratio]
