"""Frames per second of presses in small steps, one or many at once: `python -m benchmarks frames`.

A frame is 0.05 mm of motion. Spheres of 3 to 5 mm go 1 mm into the paper's gel, each at a different
place: 20 frames per press. Errors are those of the forces from 0.1 mm on, relative to the default
mesh with elements half as long, for the first presses.
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from benchmarks.sim.speed.campaign import AUGMENTATIONS, PATH_TOLERANCE, TOLERANCE
from benchmarks.sim.speed.machine import machine_name
from recorder.command_line.options import add_device
from recorder.processes import Workers, cores
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import sphere
from sim.layer import Layer
from sim.result import Outcome, force_scale
from sim.scene import Body, Scene, press
from sim.tiers import simulate_many

MM = 1e-3
FRAME, FRAMES = 0.05 * MM, 20
# Numbers of simultaneous presses, and the most.
COUNTS = (1, 64, 256, 1024)
MOST = 4096
# Number of presses whose errors are measured.
JUDGED = 4
# First frame whose error is measured, 0 being the touch: 0.1 mm.
FROM = 2
# Presses that fill a GPU: from there on their time grows with their number.
FILLS = 64
# Frames per second that others state for tactile simulators with soft contact, as in their papers:
# other scenes, other hardware, and no error of the force.
PUBLISHED = (
    ("TaCauchy (arXiv 2606.20426)", 1, 33.4),
    ("TaCauchy (arXiv 2606.20426)", 60, 555.0),
    ("ETac, a learned model", 4096, 869.0),
)


@dataclass(frozen=True, slots=True)
class Way:
    """One way to solve the presses."""

    name: str
    tier: Layer | Fem


def ways() -> list[Way]:
    """Return `layer`, coarse meshes of `fem` with matching tolerances, and the default."""
    found = [Way(f"layer, {grid} pixels", Layer(grid=grid)) for grid in (48, 64, 128)]
    for spacing in (1.33, 1.0, 0.8):
        quick = Fem(
            spacing=spacing * MM,
            tolerance=TOLERANCE,
            path_tolerance=PATH_TOLERANCE,
            augmentations=AUGMENTATIONS,
            one_topology=True,
        )
        found.append(Way(f"fem, {spacing:g} mm", quick))
    return [*found, Way("fem, default", Fem(one_topology=True))]


def scenes(count: int) -> list[Scene]:
    """Return the first `count` presses, which are the same for every count."""
    random = np.random.default_rng(0)
    drawn = random.uniform([3 * MM, -4 * MM, -4 * MM], [5 * MM, 4 * MM, 4 * MM], (count, 3))
    depths = [FRAME * frame for frame in range(1, FRAMES + 1)]
    return [Scene(sphere(r), press(depths, at=(x, y)), Body()) for r, x, y in drawn]


def solved(
    way: Way, some: Sequence[Scene], device: str, solvers: Workers | None = None
) -> tuple[float, list[Outcome]]:
    """Return the time to solve the presses [s], and their outcomes; without `solvers`, here."""
    tier = way.tier
    if isinstance(tier, Fem) and device == "cpu":
        tier = replace(tier, one_topology=False)
    began = time.perf_counter()
    outcomes = simulate_many(some, tier, device=device, processes=solvers or 1)
    return time.perf_counter() - began, outcomes


def errors(outcomes: Sequence[Outcome], truths: Sequence[Outcome]) -> tuple[float, float]:
    """Return mean and largest error [%] of the presses that have a reference."""
    found = []
    for one, truth in zip(outcomes, truths, strict=False):
        if isinstance(one, SimulationDiverged) or isinstance(truth, SimulationDiverged):
            continue
        off = np.linalg.norm(one.force - truth.force, axis=1) / force_scale(truth.force)
        found.append(100 * off[FROM:])
    return (float(np.mean(found)), float(np.max(found))) if found else (np.nan, np.nan)


@dataclass(frozen=True, slots=True)
class Row:
    """Frames per second of one way to solve a number of presses at once."""

    way: str
    device: str
    processes: int
    at_once: int
    elements: int
    """Elements of the first press; of `layer`, pixels."""
    frames: int
    """Frames of all presses that have a solution."""
    seconds: float
    frames_per_second: float
    without_solution: int
    error_mean_percent: float
    error_worst_percent: float

    def line(self) -> str:
        """Return the row of the printed table."""
        return (
            f"| {self.way} | {self.device} | {self.processes} | {self.at_once} "
            f"| {self.elements:,} "
            f"| {self.seconds:.3g} | {self.frames_per_second:,.4g} | {self.without_solution} "
            f"| {self.error_mean_percent:.2f} % | {self.error_worst_percent:.2f} % |"
        )


HEAD = (
    "| way | device | processes | at once | elements | seconds | frames/s | without a solution "
    "| error, mean | worst |"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Times presses of 20 frames of 0.05 mm with `layer` and with meshes of `fem`, "
        "and reports the errors of their forces. Kernels are compiled and processes started before."
    )
    add_device(parser)
    parser.add_argument(
        "--counts",
        default=",".join(map(str, COUNTS)),
        help="numbers of simultaneous presses, one row each (%(default)s)",
    )
    parser.add_argument(
        "--processes",
        type=int,
        help="processes that share several presses (default: 1 beside a GPU, on a CPU as many as "
        "it has cores)",
    )
    parser.add_argument(
        "--only", default="", metavar="WORD", help="only methods whose name contains this"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=200.0,
        help="time for all rows; larger numbers of presses that would exceed it are left out, and "
        "named (%(default)g)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for frames-DEVICE.csv (default: none)"
    )


def run(options: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    """Print the table, write it as CSV, and return 0.

    Raises:
        SceneError: Counts that are not integers from 1 to the largest, or an unknown device.
    """
    from sim.device import ready_device
    from sim.tiers import check_processes

    counts = _counts(options.counts)
    processes = options.processes
    if processes is None:
        processes = cores() if options.device == "cpu" else 1
    check_processes(processes)
    ready_device(options.device)
    began = time.perf_counter()
    say(f"solving {JUDGED} presses on a fine mesh, as the reference")
    _seconds, truths = solved(
        Way("", Fem(fineness=1.5, elements_max=400_000, one_topology=True)),
        scenes(JUDGED),
        options.device,
    )
    say(
        f"{machine_name(options.device)}; frames of {FRAME / MM:g} mm, {FRAMES} a press: spheres "
        "of 3 to 5 mm, 1 mm into 20 x 20 x 4 mm"
    )
    say(HEAD)
    say("|---" * HEAD.count(" |") + "|")
    rows: list[Row] = []
    left_out: list[str] = []
    with Workers(processes) as started:
        solvers = started if processes > 1 else None
        for way in ways():
            if options.only not in way.name:
                continue
            solved(way, scenes(1), options.device)
            if solvers is not None:  # each loads its kernels
                solved(way, scenes(processes), options.device, solvers)
            last: Row | None = None
            for count in sorted(counts):
                ahead = forecast(last, count, processes)
                if time.perf_counter() - began + ahead > options.seconds:
                    left_out.append(f"{way.name} at {count}")
                    continue
                several = solvers if count > 1 else None
                last = measured(way, count, options.device, several, truths)
                rows.append(last)
                say(last.line())
    if left_out:
        say(f"left out, as they would exceed {options.seconds:g} s: {', '.join(left_out)}")
    say("Published, with other scenes and hardware, and without an error of the force:")
    for name, count, rate in PUBLISHED:
        say(f"| {name} | {count} at once | {rate:g} frames/s |")
    if options.out is not None:
        say(f"{written(rows, options.out, options.device)}: written")
    return 0


def forecast(last: Row | None, count: int, processes: int) -> float:
    """Return the expected time of `count` presses [s], by a row with fewer; 0 if it is unknown."""
    if last is None:
        return 0.0
    if last.device == "cpu":
        return last.seconds * math.ceil(count / processes) / math.ceil(last.at_once / processes)
    return last.seconds * count / last.at_once if last.at_once >= FILLS else 0.0


def measured(
    way: Way, count: int, device: str, solvers: Workers | None, truths: Sequence[Outcome]
) -> Row:
    """Solve `count` presses, and return their row."""
    seconds, outcomes = solved(way, scenes(count), device, solvers)
    good = [one for one in outcomes if not isinstance(one, SimulationDiverged)]
    mean, worst = errors(outcomes[:JUDGED], truths)
    frames = FRAMES * len(good)
    elements = 0
    if good:
        mesh = good[0].record.get("mesh", {})
        elements = int(mesh.get("elements", good[0].traction[0, ..., 0].size))
    return Row(
        way=way.name,
        device=device,
        processes=1 if solvers is None else solvers.processes,
        at_once=count,
        elements=elements,
        frames=frames,
        seconds=seconds,
        frames_per_second=frames / seconds,
        without_solution=len(outcomes) - len(good),
        error_mean_percent=mean,
        error_worst_percent=worst,
    )


def written(rows: Sequence[Row], folder: Path, device: str) -> Path:
    """Write the rows as CSV and return the file's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"frames-{device.split(':')[0]}.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [one.name for one in fields(Row)])
        writer.writeheader()
        for row in rows:
            numbers = asdict(row).items()
            writer.writerow(
                {key: f"{one:.5g}" if isinstance(one, float) else one for key, one in numbers}
            )
    return path


def _counts(text: str) -> list[int]:
    try:
        counts = [int(one) for one in text.split(",")]
    except ValueError:
        counts = [0]
    if not all(1 <= one <= MOST for one in counts):
        raise SceneError(f"--counts: {text!r}; allowed: 1 to {MOST}, by commas")
    return counts
