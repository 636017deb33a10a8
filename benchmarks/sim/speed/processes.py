"""Time of the paper's presses by processes that share a device.

It is `python -m benchmarks speed-shared`. Processes start and load their kernels before. The meshes
are solved at once; two are extrapolated by the ratio of their spacings. A press without a solution
on the coarser one, in which the indenter may stand, has the forces of the finer one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.sim.speed.campaign import AUGMENTATIONS, PATH_TOLERANCE, REFERENCE_FILE, TOLERANCE
from benchmarks.sim.speed.forces import SHALLOW_MM, errors, extrapolated, forces_of, read_forces
from benchmarks.sim.speed.machine import machine_name
from benchmarks.sim.speed.work import paper_work, smoke_work
from recorder.command_line.options import add_device, numbers, positive, whole
from recorder.processes import Workers
from sim.cli.options import metres
from sim.errors import SceneError, SimulationDiverged
from sim.fem import FOR_EDGES, Fem
from sim.tiers import gathered, submitted


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Times the paper's 162 presses in several processes, and reports their forces' errors. "
        "Beside a GPU NVIDIA's Multi-Process Service should run: nvidia-cuda-mps-control -d."
    )
    add_device(parser)
    parser.add_argument(
        "--processes",
        type=whole(),
        default=2,
        metavar="N",
        help="number of processes (%(default)s)",
    )
    parser.add_argument(
        "--spacings",
        type=numbers(),
        default=(1.0, 1.5),
        metavar="MM,...",
        help="element heights [mm]: one, or a finer and a coarser one, extrapolated (1,1.5)",
    )
    parser.add_argument(
        "--tolerance",
        type=positive,
        default=TOLERANCE,
        help="residual over force at the depths that are stored (%(default)g)",
    )
    parser.add_argument(
        "--repeat", type=whole(), default=2, metavar="N", help="timed runs (%(default)s)"
    )
    parser.add_argument(
        "--reference",
        type=Path,
        default=Path("docs/results/speed") / REFERENCE_FILE,
        metavar="CSV",
        help="forces that errors are relative to (%(default)s)",
    )
    parser.add_argument("--smoke", action="store_true", help="a few shallow presses")


def run(options: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    """Print times and errors, and return 0.

    Raises:
        SceneError: More than two spacings, or the first one is not the finer one.
    """
    sizes = options.spacings
    if not (len(sizes) == 1 or (len(sizes) == 2 and 0 < sizes[0] < sizes[1])):
        raise SceneError(f"--spacings: {sizes!r}; allowed: one, or a finer and a coarser one [mm]")
    presses = (smoke_work() if options.smoke else paper_work()).presses
    scenes = [press.scene() for press in presses]
    tiers = [
        Fem(
            spacing=metres(size),
            grading=FOR_EDGES,
            tolerance=options.tolerance,
            path_tolerance=PATH_TOLERANCE,
            augmentations=AUGMENTATIONS,
            one_topology=options.device != "cpu",
        )
        for size in sizes
    ]
    say(f"{machine_name(options.device)}, {options.processes} processes, {len(scenes)} presses")
    with Workers(options.processes) as workers:
        for turn in range(options.repeat + 1):
            began = time.perf_counter()
            calls = [submitted(workers, scenes, tier, options.device) for tier in tiers]
            found = [gathered(workers, each) for each in calls]
            seconds = time.perf_counter() - began
            say(f"{'with their start' if not turn else 'then'}: {seconds:.3g} s")
    failed = [sum(isinstance(one, SimulationDiverged) for one in outcomes) for outcomes in found]
    say(
        "without a solution: "
        + ", ".join(f"{count} on {size:g} mm" for count, size in zip(failed, sizes, strict=True))
    )
    forces, *coarse = (forces_of(presses, outcomes) for outcomes in found)
    if coarse:
        forces |= extrapolated(forces, coarse[0], sizes[1] / sizes[0])
    off = errors(forces, read_forces(options.reference), from_mm=SHALLOW_MM)
    say(
        f"forces of {len({key[:3] for key in forces})} presses; error of {off.presses} from "
        f"{SHALLOW_MM:g} mm on: mean {100 * off.mean:.2f} %, 95 % below {100 * off.most:.2f} %, "
        f"worst {100 * off.worst:.2f} %"
    )
    return 0
