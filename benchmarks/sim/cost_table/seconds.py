"""Presses timed one by one on a device, which predictions of seconds are fitted to."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.sim.cost_table.measure import work_of
from benchmarks.sim.cost_table.scenes import TRAINING, batch
from benchmarks.sim.spent import spent_by
from sim.errors import SimulationDiverged
from sim.planner.features import LADDER, Choice, probe
from sim.planner.seconds import COLUMNS, Timed, device_kind
from sim.scene import Scene, press
from sim.simulate import simulate

SEED = 77


WARM = 1 / 200
"""Depth over thickness of the press that loads the kernels before one is timed."""


def time_presses(
    device: str, machine: str, batches: int, seconds_max: float, say: Callable[[str], None]
) -> list[Timed]:
    """Presses timed one by one, `batches` scenes on every mesh, coarse to fine.

    A mesh is left out where it is expected to take more than `seconds_max`.
    """
    found: list[Timed] = []
    for index in range(batches):
        scene = batch(SEED, index, TRAINING)[0]
        looked = probe(scene)
        say(f"[{index + 1}/{batches}] {scene.indenter.name}, {looked.features.group}")
        if device == "cpu":
            found += _timed(scene, Choice("layer"), device, machine)
        for precision in ("float32", "float64"):
            last = 0.0
            for before, cells in zip((LADDER[0], *LADDER), LADDER, strict=False):
                if last * (cells / before) ** 4 > seconds_max:
                    break
                choice = Choice("fem", cells, precision)
                now = _timed(scene, choice, device, machine)
                found += now
                last = now[0].seconds if now else last
    return found


def write(path: Path, timed: Sequence[Timed]) -> None:
    """Write timed presses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for one in timed:
            choice = one.choice
            writer.writerow(
                (one.device, one.machine, choice.tier, choice.cells, choice.precision,
                 f"{one.elements:.0f}", f"{one.newton:.0f}", f"{one.cg:.0f}", one.frames,
                 f"{one.seconds:.4g}")
            )  # fmt: skip


def _timed(scene: Scene, choice: Choice, device: str, machine: str) -> list[Timed]:
    """The timed press; empty where it has no solution."""
    numerics = choice.numerics(scene.body)
    shallow = replace(scene, motion=press([WARM * scene.body.thickness]))
    coarse = Choice(choice.tier, LADDER[0] if choice.tier == "fem" else 0, choice.precision)
    try:
        simulate(shallow, choice.tier, numerics=coarse.numerics(scene.body), device=device)
        result, spent = spent_by(
            lambda: simulate(scene, choice.tier, numerics=numerics, device=device), device
        )
    except SimulationDiverged:
        return []
    seconds = spent.cpu if device == "cpu" else spent.wall
    work = work_of(result)
    frames = len(scene.motion)
    kind = device_kind(device)
    return [Timed(kind, machine, choice, **work, frames=frames, seconds=seconds)]
