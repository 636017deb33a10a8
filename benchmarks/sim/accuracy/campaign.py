"""Measure errors, time and memory of every competitor on every case into a file of rows."""

from __future__ import annotations

import multiprocessing
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.sim.accuracy.cases import CASES, FINENESS, Case, chosen
from benchmarks.sim.accuracy.closed_form import closed_form
from benchmarks.sim.accuracy.competitors import Competitor, by_name, competitors
from benchmarks.sim.accuracy.errors import compare
from benchmarks.sim.accuracy.reference import Reference, references
from benchmarks.sim.accuracy.row import MEASURES, Row, append, begin, read
from benchmarks.sim.launches import in_launches
from benchmarks.sim.spent import spent_by
from recorder.progress import duration
from sim.errors import SceneError, SimulationDiverged
from sim.metrics import outcome_of
from sim.result import WEAK, Result
from sim.scene import Scene, press

# Depth of the press that loads the kernels before a measurement [m].
WARM = 0.02e-3
# Assumed power law of the time of a press with fineness, used to skip slow measurements.
GROWTH = 4.0
# Ladder of the closed-form solutions, which take no time.
CLOSED_FORM = "closed form"


@dataclass(frozen=True, slots=True)
class AccuracyCampaign:
    """Selection and limits of the measurements."""

    device: str
    cases: tuple[Case, ...]
    competitors: tuple[Competitor, ...]
    fineness: float | None
    """Fineness of the references' meshes; None: that of each case."""
    seconds_max: float
    """Measurements expected to take longer are skipped [s]."""
    cache: Path
    """Folder of the cached references."""
    processes: int = 1
    """Processes that solve references beside a GPU."""


def measure(plan: AccuracyCampaign, path: Path, say: Callable[[str], None]) -> None:
    """Run the measurements that are missing from the file at `path`, and append each as a line."""
    begin(path, machine(plan.device), plan.device, _reference_text(plan))
    known = read(path)
    done = {row.key: row for row in known.rows}
    began = time.perf_counter()
    for index, case in enumerate(plan.cases):
        fineness = plan.fineness or case.fineness
        truth = references(case, fineness, plan.device, plan.cache, say, plan.processes)
        if case.name not in known.bounds:
            append(path, {"case": case.name, "floor": _floor(truth)})
        for row in _case_rows(plan, case, truth, done):
            append(path, row)
            say(_line(row))
        fraction = (index + 1) / len(plan.cases)
        spent = time.perf_counter() - began
        say(
            f"[{index + 1}/{len(plan.cases)}] {case.name} done, about "
            f"{duration(spent / fraction - spent)} left"
        )


def machine(device: str) -> str:
    """Return a description of the machine."""
    if device == "cpu":
        return f"one core of {platform.machine()} ({os.cpu_count()} cores)"
    import warp as wp

    return str(wp.get_device(device).name)


def _case_rows(
    plan: AccuracyCampaign,
    case: Case,
    truth: Sequence[Reference | None],
    done: dict[tuple[str, str, str], Row],
) -> Iterator[Row]:
    """Yield the rows of a case that are not in `done`, closed form first."""
    if (case.name, CLOSED_FORM, "none") not in done:
        row = _closed_form_row(case, truth)
        if row is not None:
            yield row
    before: dict[str, Row] = {}
    for one in plan.competitors:
        device = "cpu" if one.cpu_only else plan.device
        if one.cpu_only and plan.device != "cpu":
            continue
        if device == "cpu" and one.cpu_cases is not None and case.name not in one.cpu_cases:
            continue
        last = before.get(one.ladder)
        found = done.get((case.name, one.name, device))
        if found is None:
            if last is not None and _too_long(last, one, len(case.scenes), plan.seconds_max):
                continue
            found = _measured(case, one, device, truth)
            yield found
        before[one.ladder] = found


def _too_long(last: Row, one: Competitor, scenes: int, seconds_max: float) -> bool:
    if not np.isfinite(last.wall):
        return False
    expected = last.wall * scenes * (one.fineness / last.fineness) ** GROWTH
    return bool(expected > seconds_max)


def _measured(case: Case, one: Competitor, device: str, truth: Sequence[Reference | None]) -> Row:
    """Measure a row; on a CPU in a separate process, so that its memory is that of the press."""
    if device != "cpu":
        return measure_here(case, one, device, truth)
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        # Spawned: Warp's state does not survive a fork.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as executor:
            task = executor.submit(_measure_there, case.name, one.name, device, list(truth))
            return task.result()
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def _measure_there(case: str, competitor: str, device: str, truth: list[Reference | None]) -> Row:
    from sim.device import ready_device

    ready_device(device)
    return measure_here(chosen((case,))[0], by_name(competitor), device, truth)


def measure_here(
    case: Case, one: Competitor, device: str, truth: Sequence[Reference | None]
) -> Row:
    """Measure `one` on a case in this process and return the row."""
    empty = Row(case.name, one.ladder, one.label, one.fineness, device)
    coarsest = next(each for each in competitors() if each.ladder == one.ladder)
    try:
        coarsest.solve([_warm(case.scenes[0])], device)
        outcomes, spent = spent_by(lambda: in_launches(one.solve, case.scenes, device), device)
    except SceneError as error:
        return replace(empty, note=f"rejected: {error}")
    found = [
        compare(outcome_of(outcome), true.outcome, scene.body)
        for scene, outcome, true in zip(case.scenes, outcomes, truth, strict=True)
        if isinstance(outcome, Result) and true is not None
    ]
    solved = [outcome for outcome in outcomes if isinstance(outcome, Result)]
    failed = [str(outcome) for outcome in outcomes if isinstance(outcome, SimulationDiverged)]
    count = len(case.scenes)
    row = replace(
        empty,
        wall=spent.wall / count,
        cpu=spent.cpu / count,
        memory=spent.memory,
        elements=_elements(solved[0]) if solved else 0,
        failed=len(failed),
        note=failed[0] if failed else "",
    )
    if not found:
        return row
    worst = [errors.worst() for errors in found]
    return replace(
        row,
        mean={name: _mean([each[name] for each in worst]) for name in MEASURES},
        worst={name: float(np.nanmax([each[name] for each in worst])) for name in MEASURES},
        axes=tuple(float(value) for value in np.max([e.force.max(axis=0) for e in found], axis=0)),
    )


def _warm(scene: Scene) -> Scene:
    """Return the shallowest press that uses the same kernels."""
    return replace(scene, motion=press([WARM]))


def _closed_form_row(case: Case, truth: Sequence[Reference | None]) -> Row | None:
    """Return the row of the formula, or None without a common formula or a reference."""
    true = truth[0]
    force = closed_form(case.name, case.scenes[0])
    if force is None or true is None:
        return None
    known = true.outcome.force
    size = np.linalg.norm(known, axis=1)
    error = np.abs(force - known)
    fraction = error / np.maximum(size, WEAK * size.max())[:, None]
    errors = dict.fromkeys(MEASURES, np.nan) | {
        "force": float(error.max()),
        "force_share": float(fraction.max()),
        "force_last": float(fraction[-1].max()),
    }
    axes = tuple(float(value) for value in error.max(axis=0))
    return Row(case.name, CLOSED_FORM, "", 0.0, "none", 0.0, 0.0, 0, 0, errors, errors, axes)


def _floor(truth: Sequence[Reference | None]) -> dict[str, float]:
    known = [one.uncertainty for one in truth if one is not None]
    return {name: _mean([each.get(name, np.nan) for each in known]) for name in MEASURES}


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def _elements(result: Result) -> int:
    """Return the number of elements, particles, or pixels."""
    record = result.record
    if "particles" in record:
        return int(record["particles"])
    mesh = record["mesh"]
    return int(mesh["elements"] if "elements" in mesh else np.prod(mesh["grid"]))


def _reference_text(plan: AccuracyCampaign) -> str:
    own = [f"`{one.name}`: {one.fineness:g}" for one in CASES if one.fineness != FINENESS]
    fineness = f"{plan.fineness:g}" if plan.fineness else f"{FINENESS:g} ({', '.join(own)})"
    return f"fem float64, fineness {fineness}, 5 augmentations, tolerance 1e-5"


def _line(row: Row) -> str:
    name = f"{row.case:>10} {row.name:<22} {row.device}:"
    if not row.mean:
        return f"{name} {row.note or 'nothing'}"
    reported = [f"force {100 * row.mean['force_share']:.2f} %"]
    if np.isfinite(row.mean["surface_rms"]):
        reported.append(f"surface {row.mean['surface_rms'] * 1e6:.1f} um")
        reported.append(f"markers {row.mean['marker_rms']:.3f} px")
        reported.append(f"{row.wall:.3f} s, {row.memory / 2**20:.0f} MiB")
    if row.failed:
        reported.append(f"{row.failed} without a solution")
    return f"{name} {', '.join(reported)}"
