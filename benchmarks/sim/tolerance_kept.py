"""Tolerances on randomly drawn scenes: `python -m benchmarks tolerance`.

The reference is extrapolated (Richardson 1911, order 2) from the answer's mesh, or one as fine, and
one `FINER` times finer. It uses the same solver, so it measures discretisation error only; other
errors are covered by `hard-cases --random` and `independent`.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.hard_cases.random_scenes.judgement import OutOfTime, time_limit
from benchmarks.hard_cases.random_scenes.scenes import Drawn, drawn
from benchmarks.processes import INTERRUPTED, done_counts, side_by_side
from recorder.command_line.options import add_device, add_seed
from recorder.progress import duration
from recorder.store import replace_file
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.metrics import tolerance_of
from sim.planning import plan
from sim.result import Result, force_scale
from sim.scene import Scene
from sim.tiers import simulate
from sim.tolerance import RATIO_LEAST, elements_ratio, left_of_difference

# Element size of the answer over that of the reference.
FINER = 1.6
# Minimum fineness of the coarser mesh of a reference.
COARSEST = 0.75
# Maximum number of elements of a reference.
TRUTH_ELEMENTS_MAX = {"cpu": 600_000, "cuda": 4_000_000}
# Family of the drawn scenes to use: typical uses.
FAMILY = "sensible"

Kind = Literal["kept", "missed", "refused", "diverged", "timeout", "no truth"]


@dataclass(frozen=True, slots=True)
class Row:
    """Result for one scene."""

    name: str
    """Seed and number of the scene."""
    what: str
    kind: Kind
    error_percent: float = math.nan
    """Largest difference from the reference over frames, as defined for the tolerance."""
    own_percent: float = math.nan
    """Error estimate of the result."""
    truth_percent: float = math.nan
    """Half of the extrapolation step of the reference."""
    tier: str = ""
    seconds: float = math.nan
    truth_seconds: float = math.nan
    reported: str = ""


def scenes(count: int, seed: int) -> list[Drawn]:
    """Return the first `count` sensible scenes of a seed with contact."""
    found: list[Drawn] = []
    index = 0
    while len(found) < count:
        one = drawn(seed, index)
        index += 1
        if one.what.split(",")[0] != FAMILY or one.scene is None:
            continue
        if one.scene.motion.depth_max > 0:
            found.append(one)
    return found


def _numbers(text: str) -> list[int]:
    """Return the numbers of scenes in a text such as "18,24".

    Raises:
        SceneError: It is not a list of whole numbers.
    """
    try:
        return [int(one) for one in text.split(",")]
    except ValueError:
        raise SceneError(f"--only: {text!r}; allowed: numbers such as '18,24'") from None


def judged(one: Drawn, tolerance: str, device: str, seconds: float) -> Row:
    """Solve a scene within a tolerance and again on finer meshes, and compare."""
    assert one.scene is not None
    row = partial(Row, one.name, one.what)
    began = time.perf_counter()
    try:
        with time_limit(seconds):
            result = plan(one.scene, tolerance, device=device).run()
    except SceneError as error:
        return row("refused", seconds=time.perf_counter() - began, reported=str(error))
    except SimulationDiverged as error:
        return row("diverged", seconds=time.perf_counter() - began, reported=str(error))
    except OutOfTime as error:
        return row("timeout", seconds=time.perf_counter() - began, reported=str(error))
    took = time.perf_counter() - began
    own = float(result.record["error"]["percent"])
    began = time.perf_counter()
    try:
        with time_limit(4 * seconds):
            force, unsure = _truth(one.scene, result, device)
    except (SceneError, SimulationDiverged, OutOfTime) as error:
        return row("no truth", own_percent=own, tier=result.tier, seconds=took, reported=str(error))
    scale = np.maximum(force_scale(force), 1e-12)
    off = 100 * float((np.abs(result.force - force).max(axis=1) / scale).max())
    kind: Kind = "kept" if off <= 100 * tolerance_of(tolerance).value else "missed"
    truth_percent = 100 * float((unsure / scale).max())
    spent = time.perf_counter() - began
    return row(kind, off, own, truth_percent, result.tier, took, spent)


def _truth(scene: Scene, result: Result, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the extrapolated force (F, 3) [N], and its uncertainty (F,) [N].

    Raises:
        SceneError: The limit on elements makes both meshes too similar.
        SimulationDiverged: A mesh found no solution.
    """
    most = TRUTH_ELEMENTS_MAX["cpu" if device == "cpu" else "cuda"]
    fineness = result.record["mesh"].get("fineness", COARSEST)
    finest, middle = (
        simulate(scene, Fem(fineness=one, elements_max=most), device=device)
        for one in (max(COARSEST, fineness) * FINER, max(COARSEST, fineness))
    )
    ratio = elements_ratio(middle, finest)
    if ratio < RATIO_LEAST:
        raise SceneError(f"reference: a mesh of more than {most} elements; allowed: fewer")
    step = (finest.force - middle.force) * left_of_difference(ratio)
    return finest.force + step, np.abs(step).max(axis=1) / 2


def summary(rows: Sequence[Row], tolerance: str) -> str:
    """Return the numbers of tolerances kept, missed and rejected as a line."""
    counts = {kind: sum(row.kind == kind for row in rows) for kind in Kind.__args__}  # type: ignore[attr-defined]
    given = counts["kept"] + counts["missed"]
    none = counts["refused"] + counts["diverged"] + counts["timeout"]
    fraction = 100 * counts["kept"] / max(given, 1)
    median = float(np.median([row.seconds for row in rows]))
    return (
        f"{len(rows)} scenes within {tolerance}: kept {counts['kept']} of {given} with a known "
        f"reference ({fraction:.1f} %), no answer {none} ({100 * none / len(rows):.1f} %: "
        f"{counts['refused']} refused, {counts['diverged']} diverged, {counts['timeout']} out of "
        f"time), no truth {counts['no truth']}; median {median:.2g} s"
    )


def line(row: Row) -> str:
    """Return a row of the table."""
    text = f"{row.kind:8} {row.name:<8} {row.what:<60} {row.seconds:6.1f} s {row.tier:5}"
    if row.reported:
        return f"{text}  {row.reported[:200]}"
    return (
        f"{text} error {row.error_percent:.2f} %, own {row.own_percent:.2f} %, "
        f"truth {row.truth_percent:.2f} %"
    )


def _write(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV; a run that is ended keeps those of the scenes before."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([one.name for one in fields(Row)])
    writer.writerows(astuple(row) for row in rows)
    replace_file(path, file.getvalue().encode())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Draws scenes, solves each within a tolerance and again on finer meshes, and "
        "reports how often the tolerance was met. Exit code 1 if this is below 95 %."
    )
    parser.add_argument("--scenes", type=int, default=200, help="number of scenes (%(default)s)")
    add_seed(parser)
    parser.add_argument(
        "--only", metavar="N,N", help="numbers of the seed's scenes to solve, instead of the first"
    )
    parser.add_argument("--tolerance", default="3 %", help="force tolerance (3 %%)")
    add_device(parser)
    parser.add_argument(
        "--processes", type=int, default=1, help="number of parallel processes (%(default)s)"
    )
    parser.add_argument(
        "--seconds", type=float, default=300.0, help="time limit of a solve (%(default)g)"
    )
    parser.add_argument(
        "--csv", type=Path, metavar="FILE", help="also write the rows to this file, after each"
    )


def run(options: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    """Judge the scenes; return 0, or 1 if fewer than 95 % of the answers meet the tolerance.

    Raises:
        SceneError: An option out of range, or a tolerance that is not in per cent of the force.
    """
    from sim.device import ready_device

    for name in ("scenes", "processes"):
        if getattr(options, name) < 1:
            raise SceneError(f"--{name}: {getattr(options, name)}; allowed: 1 or more")
    if tolerance_of(options.tolerance).kind != "fraction":
        raise SceneError(f"--tolerance: {options.tolerance!r}; allowed: such as '3 %'")
    ready_device(options.device)
    judge = partial(
        judged, tolerance=options.tolerance, device=options.device, seconds=options.seconds
    )
    began = time.perf_counter()
    rows: list[Row] = []
    chosen = scenes(options.scenes, options.seed)
    if options.only:
        chosen = [drawn(options.seed, number) for number in _numbers(options.only)]
        for one in chosen:
            if one.scene is None:
                raise SceneError(f"--only: {one.name} is no scene ({one.refusal}); allowed: others")
    with done_counts(say):
        for row in side_by_side(judge, chosen, options.device, min(options.processes, len(chosen))):
            rows.append(row)
            left = (time.perf_counter() - began) * (len(chosen) / len(rows) - 1)
            say(f"[{len(rows)}/{len(chosen)}] {line(row)}   {duration(left)} left")
            if options.csv:
                _write(options.csv, rows)
    if rows:
        say(summary(rows, options.tolerance))
    if len(rows) < len(chosen):
        return INTERRUPTED
    given = [row for row in rows if row.kind in ("kept", "missed")]
    return int(sum(row.kind == "kept" for row in given) < 0.95 * len(given))
