"""Measuring the table: every choice on every scene against one finer mesh, batch by batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

import sim.planner.error_model as table_file
from benchmarks.sim.accuracy.reference import VISCOUS_PARTS, reference_numerics, solve_references
from benchmarks.sim.cost_table.scenes import BATCH, Ranges, batch
from benchmarks.sim.launches import in_launches
from sim.errors import SceneError, SimulationDiverged
from sim.fem.numerics import Numerics
from sim.metrics import Outcome, outcome_of, worst_errors
from sim.planner.error_model import CostRow, Table
from sim.planner.features import KINDS, LADDER, Choice, Kind, Probe, companion, probe
from sim.planner.plan import conditions_text
from sim.progress import duration
from sim.result import Result
from sim.scene import Scene
from sim.simulate import simulate_many

REFERENCE_CELLS = 12
"""Elements that one thickness is long in the reference."""
REFERENCE_PRECISION: Literal["auto"] = "auto"
"""Of the reference: `auto` ends in float64 where float32 does not reach its tolerance."""
PRECISION_CELLS = 5
"""The mesh that is solved in float64 too, to see what float32 does to it."""
NOTHING = float("nan")


@dataclass(frozen=True, slots=True)
class Campaign:
    """What is measured."""

    name: str
    """Of the table: `training` or `held-out`; its scenes are called so."""
    seed: int
    batches: int
    """Of `BATCH` scenes each."""
    ranges: Ranges
    device: str
    reference_cells: int = REFERENCE_CELLS
    ladder: tuple[int, ...] = LADDER
    """Meshes of `fem` that are solved, as elements that one thickness is long."""

    def conditions(self) -> dict[str, str]:
        """What the table depends on; a table of other conditions is another table."""
        finest = _differing(reference_numerics(1.0, REFERENCE_PRECISION))
        return {
            "scenes": f"{self.name}, seed {self.seed}, {BATCH} a batch",
            "reference": f"element 1/{self.reference_cells} of the thickness, "
            f"{finest}, viscous time steps 1/{VISCOUS_PARTS}",
            "meshes": " ".join(map(str, self.ladder)),
            "numerics": conditions_text(),
        }


def measure(campaign: Campaign, folder: Path, say: Callable[[str], None]) -> Table:
    """The table, of batches in `folder` as far as they are there; each is kept when it is done.

    The whole, as far as it goes, is `NAME.csv` in the same folder.
    """
    conditions = campaign.conditions()
    tables: list[Table] = []
    began, fresh = time.perf_counter(), 0
    for index in range(campaign.batches):
        path = folder / f"{campaign.name}-{campaign.seed}-{index:03}.csv"
        if path.exists():
            known = table_file.read(path)
            if known.conditions == conditions:
                tables.append(known)
                continue
        rows = measure_batch(campaign, index, say)
        tables.append(Table(conditions, tuple(rows)))
        table_file.write(path, tables[-1])
        table_file.write(folder / f"{campaign.name}.csv", table_file.merged(tables))
        fresh += 1
        each = (time.perf_counter() - began) / fresh
        left = campaign.batches - index - 1
        say(
            f"[{index + 1}/{campaign.batches}] {len(rows)} rows, {each:.0f} s a batch, at most "
            f"{duration(each * left)} left"
        )
    whole = table_file.merged(tables)
    table_file.write(folder / f"{campaign.name}.csv", whole)
    return whole


def measure_batch(campaign: Campaign, index: int, say: Callable[[str], None]) -> list[CostRow]:
    """Rows of one batch; a scene without a reference has none, and is told of."""
    drawn = batch(campaign.seed, index, campaign.ranges)
    spacing = drawn[0].body.thickness / campaign.reference_cells
    known: list[tuple[str, Scene, Probe, Outcome]] = []
    truth = solve_references(drawn, spacing, campaign.device, REFERENCE_PRECISION)
    for number, (scene, true) in enumerate(zip(drawn, truth, strict=True)):
        name, looked = f"{campaign.name}-{campaign.seed}-{index:03}-{number}", _probe(scene)
        if isinstance(true, SimulationDiverged) or looked is None:
            say(f"  {name} ({scene.indenter.name}) left out, it has no reference")
        else:
            known.append((name, scene, looked, true))
    if not known:
        return []
    scenes, probes = [one[1] for one in known], [one[2] for one in known]
    choices = measured(campaign)
    solved = {one: _solve(one, scenes, probes, campaign.device) for one in choices}
    rows: list[CostRow] = []
    for number, (name, scene, looked, true) in enumerate(known):
        mine = {choice: outcomes[number] for choice, outcomes in solved.items()}
        rows += [_row(name, scene, looked, choice, mine, true) for choice in mine]
    return rows


def measured(campaign: Campaign) -> list[Choice]:
    """What is solved: `layer`, each mesh in float32, and one in float64."""
    meshes = [Choice("fem", cells) for cells in campaign.ladder]
    double = [Choice("fem", PRECISION_CELLS, "float64")] * (PRECISION_CELLS in campaign.ladder)
    return [Choice("layer"), *meshes, *double]


def other(choice: Choice) -> Choice | None:
    """What a row's `bar` is the difference from; None where there is nothing."""
    if choice.precision == "float64":
        return Choice("fem", choice.cells)
    try:
        return companion(choice)
    except SceneError:
        return None


def _probe(scene: Scene) -> Probe | None:
    try:
        return probe(scene)
    except SimulationDiverged:
        return None


def _solve(
    choice: Choice, scenes: Sequence[Scene], probes: Sequence[Probe], device: str
) -> list[Result | None]:
    """Results in the scenes' order, None where there is none."""
    if choice.tier == "layer":
        return [one.result for one in probes]
    numerics = choice.numerics(scenes[0].body)

    def solve(some: Sequence[Scene], where: str) -> list[Result | SimulationDiverged]:
        return simulate_many(some, "fem", numerics=numerics, device=where)

    outcomes = in_launches(solve, scenes, device)
    return [one if isinstance(one, Result) else None for one in outcomes]


def _row(
    name: str,
    scene: Scene,
    looked: Probe,
    choice: Choice,
    mine: dict[Choice, Result | None],
    true: Outcome,
) -> CostRow:
    result = mine[choice]
    against = other(choice)
    second = None if against is None else mine.get(against)
    nothing: dict[Kind, float] = dict.fromkeys(KINDS, NOTHING)
    bar = nothing
    if result is not None and second is not None:
        bar = differences(outcome_of(result), outcome_of(second), scene, looked)
    error: dict[Kind, float] = dict.fromkeys(KINDS, float("inf"))
    work = {"elements": 0.0, "newton": 0.0, "cg": 0.0}
    if result is not None:
        error = differences(outcome_of(result), true, scene, looked)
        work = work_of(result)
    return CostRow(name, scene.indenter.name, looked.features, choice, work, error, bar)


def differences(one: Outcome, other: Outcome, scene: Scene, looked: Probe) -> dict[Kind, float]:
    """How far two outcomes are apart in each kind, over the scales of the probe."""
    found = worst_errors(one, other, scene.body)
    return {kind: found[kind] / scale for kind, scale in looked.scales.items()}


def work_of(result: Result) -> dict[str, float]:
    """Elements, and Newton and conjugate-gradient iterations of all frames."""
    mesh = result.record["mesh"]
    return {
        "elements": float(mesh["elements"] if "elements" in mesh else np.prod(mesh["grid"])),
        "newton": float(result.quality.newton.sum()),
        "cg": float(result.quality.cg.sum()),
    }


def _differing(numerics: Numerics) -> str:
    usual = Numerics(spacing=1.0)
    names = [name for name in Numerics.__slots__ if getattr(numerics, name) != getattr(usual, name)]
    return ", ".join(f"{name} {getattr(numerics, name)}" for name in names)
