"""Frames per second of presses in small steps, one or many at once: `python -m benchmarks frames`.

A frame is 0.05 mm of motion. Spheres of 3 to 5 mm go 1 mm into the paper's gel, each at a different
place: 20 frames per press. Errors are those of the forces from 0.1 mm on, relative to the default
mesh with elements half as long, for the first presses.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.sim.speed.campaign import AUGMENTATIONS, PATH_TOLERANCE, TOLERANCE
from benchmarks.sim.speed.machine import machine_name
from recorder.command_line.options import add_device
from sim.errors import SceneError, SimulationDiverged
from sim.fem.numerics import Fem
from sim.indenters import sphere
from sim.layer import Layer
from sim.metrics import force_scale
from sim.result import Outcome
from sim.scene import Body, Scene, press
from sim.tiers import simulate_many

MM = 1e-3
FRAME, FRAMES = 0.05 * MM, 20
# Numbers of simultaneous presses.
COUNTS = (1, 64, 256, 1024)
# Number of presses whose errors are measured.
JUDGED = 4
# First frame whose error is measured, 0 being the touch: 0.1 mm.
FROM = 2


@dataclass(frozen=True, slots=True)
class Way:
    """One way to solve the presses."""

    name: str
    tier: Layer | Fem


def ways() -> list[Way]:
    """Return `layer`, three coarse meshes of `fem` with matching tolerances, and the default."""
    found = [Way("layer", Layer())]
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
    drawn = random.uniform([3 * MM, -4 * MM, -4 * MM], [5 * MM, 4 * MM, 4 * MM], (max(COUNTS), 3))
    depths = [FRAME * frame for frame in range(1, FRAMES + 1)]
    return [Scene(sphere(r), press(depths, at=(x, y)), Body()) for r, x, y in drawn[:count]]


def solved(
    way: Way, some: Sequence[Scene], device: str, processes: int
) -> tuple[float, list[Outcome]]:
    """Return the time to solve the presses [s], and their outcomes."""
    tier = way.tier
    on_cpu = device == "cpu" or isinstance(tier, Layer)
    if isinstance(tier, Fem) and on_cpu:
        tier = replace(tier, one_topology=False)
    began = time.perf_counter()
    outcomes = simulate_many(
        some,
        tier,
        device="cpu" if on_cpu else device,
        processes=min(processes, len(some)) if on_cpu else 1,
    )
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Times presses of 20 frames of 0.05 mm with `layer` and with meshes of `fem`, "
        "and reports the errors of their forces. Kernels are compiled before."
    )
    add_device(parser)
    parser.add_argument(
        "--counts",
        default=",".join(map(str, COUNTS)),
        help="numbers of simultaneous presses, one row each (%(default)s)",
    )
    parser.add_argument(
        "--processes", type=int, default=2, help="processes on the CPU (%(default)s)"
    )
    parser.add_argument(
        "--only", default="", metavar="WORD", help="only methods whose name contains this"
    )


def run(options: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    """Print the table and return 0.

    Raises:
        SceneError: Counts that are not integers from 1 to the largest.
    """
    from sim.device import ready_device

    try:
        counts = [int(one) for one in options.counts.split(",")]
    except ValueError:
        counts = [0]
    if not all(1 <= one <= max(COUNTS) for one in counts):
        raise SceneError(f"--counts: {options.counts!r}; allowed: 1 to {max(COUNTS)}, by commas")
    ready_device(options.device)
    say(f"solving {JUDGED} presses on a fine mesh, as the reference")
    _seconds, truths = solved(
        Way("", Fem(fineness=1.5, elements_max=400_000, one_topology=True)),
        scenes(JUDGED),
        options.device,
        1,
    )
    say(f"{machine_name(options.device)}; frames of {FRAME / MM:g} mm, {FRAMES} a press")
    say("| way | at once | seconds | frames/s | without a solution | error, mean | worst |")
    say("|---|---|---|---|---|---|---|")
    for way in ways():
        if options.only not in way.name:
            continue
        solved(way, scenes(1), options.device, 1)
        for count in counts:
            seconds, outcomes = solved(way, scenes(count), options.device, options.processes)
            failed = sum(isinstance(one, SimulationDiverged) for one in outcomes)
            mean, worst = errors(outcomes[:JUDGED], truths)
            say(
                f"| {way.name} | {count} | {seconds:.3g} | {count * FRAMES / seconds:,.0f} "
                f"| {failed} | {mean:.2f} % | {worst:.2f} % |"
            )
    return 0
