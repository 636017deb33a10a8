"""`tactile sim archive`: make or continue an archive of simulated sensors."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.errors import EXIT_INTERRUPTED, EXIT_WRONG_INPUT
from recorder.command_line.options import (
    add_device,
    add_seed,
    add_value,
    names,
    next_command,
    whole,
)
from sim.cli.options import STEPS_MAX, metres
from sim.errors import SceneError

if TYPE_CHECKING:
    from sim.dataset import OpenArchive, Solving
    from sim.result import ContactTier
    from sim.sensors import SimulatedSensor

STATES, GROUPS = "states", ("homogeneous", "material", "heterogeneous")
STATES_HELP = "18 indenters x 9 places x 5 depths under 12 patterns, the paper's simulated data"
ARCHIVE_SUFFIX = ".markers.zarr"
# Indenters with --smoke, and elements over the thickness.
SMOKE_SHAPES, SMOKE_CELLS = ("sphere", "prism"), 3
SMOKE_SHARE, SMOKE_STEPS = 0.01, 3
# Most sensors drawn from a twin.
DRAWS_MOST = 1000
# Presses that a GPU solves in one launch: all of the paper's.
BATCH_SIZE_GPU = 162
# Most processes that render images of presses which a GPU solves, by default.
RENDERERS = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Makes an archive of binary marker images with forces and displacement. Started again with "
        "the same options, or with the archive alone, it continues where it stopped."
    )
    parser.add_argument(
        "contents",
        metavar="CONTENTS",
        help=f"states: {STATES_HELP}, states:Array1,Circle1: under some of them; or the sensors "
        f"that press and shear along the paper's trajectory: {', '.join(GROUPS)}, or rows of "
        "sim/sensors and YAML files between commas; or an archive to continue",
    )
    group = parser.add_argument_group("contents")
    add = group.add_argument
    about = "sensors drawn from the uncertainty of each twin (of tactile twin fit) in its place"
    add_value(group, "--draws", "N", 0, about, whole(0, DRAWS_MOST))
    add(
        "--scale",
        metavar="SHARE",
        help="fraction of the targets, smoke (2 indenters, a coarse mesh) or full (0.1; states: "
        "full)",
    )
    add("--steps", type=whole(1, STEPS_MAX), metavar="N", help="frames per phase (10; smoke: 3)")
    add("--indenters", type=names, metavar="NAME,...", help="some of the 18 (all)")
    add_value(group, "--drawn", "N", 0, "randomly drawn indenters besides", int)
    add_seed(group)
    about = "archive (data/CONTENTS.markers.zarr; of several sensors: data/sensors.markers.zarr)"
    add("--out", type=Path, metavar="PATH", help=about)
    group = parser.add_argument_group("solver")
    add = group.add_argument
    add("--tier", choices=("layer", "fem"), help="layer: small strain, milliseconds (fem)")
    about = "height of an element of fem [mm] (a fifth of the thickness, 1.2 at most)"
    add("--spacing", type=float, metavar="MM", help=about)
    about = 'accepted error, "3 %%", "0.05 N" or "0.5 px", in place of --tier and --spacing'
    add("--tolerance", metavar="ERROR", help=about)
    group = parser.add_argument_group("execution")
    add_device(group)
    add = group.add_argument
    add(
        "--processes",
        type=whole(),
        metavar="N",
        help="worker processes (2); with fem on a GPU, those that render images "
        f"(at most {RENDERERS})",
    )
    add("--no-check", action="store_true", help="do not count markers at the end")


def run(options: argparse.Namespace) -> int:
    """Make or continue an archive and return the exit code."""
    from sim.dataset import DatasetPlan, begin, gel, reopened
    from sim.device import ready_device

    contents: str = options.contents
    if contents.endswith(ARCHIVE_SUFFIX):
        return _fill(options, reopened(Path(contents)))
    kind, _, patterns = contents.partition(":")
    is_states = kind == STATES
    smoke, fraction = _share(options.scale or ("full" if is_states else "0.1"))
    indenters, solving = _indenters(options, smoke=smoke), _solving(options, smoke=smoke)
    if is_states:
        chosen = tuple(patterns.split(",")) if patterns else None
        plan = DatasetPlan(
            "states", (gel(chosen),), indenters=indenters, solving=solving, seed=options.seed
        )
    else:
        plan = DatasetPlan(
            "targets",
            _sensors(options),
            indenters=indenters,
            solving=solving,
            seed=options.seed,
            steps=options.steps or (SMOKE_STEPS if smoke else 10),
            fraction=fraction,
        )
    name = kind if kind in (STATES, *GROUPS) else "sensors"
    ready_device(options.device)
    if options.device != "cpu":
        solving = replace(plan.solving, one_topology=plan.solving.tier == "fem")
        plan = replace(plan, batch_size=BATCH_SIZE_GPU, solving=solving)
    out = options.out or Path(f"data/{name}{ARCHIVE_SUFFIX}")
    return _fill(options, begin(out, plan, options.device))


def _fill(options: argparse.Namespace, opened: OpenArchive) -> int:
    """Make the missing units with progress, print a summary, and return the exit code."""
    from recorder.errors import SessionError
    from recorder.processes import WorkerLost, cores
    from recorder.progress import Progress
    from sim.dataset import fill
    from sim.dataset.run import contents, make_here, make_in_processes
    from sim.dataset.summary import summary
    from sim.device import ready_device

    go_on = f"to continue: {next_command('sim', 'archive', opened.path)}"
    kernels = ready_device(options.device)
    # Units in processes on a CPU, else in this one.
    make = make_in_processes if options.device == "cpu" else make_here
    usual = 2 if options.device == "cpu" else max(1, min(RENDERERS, cores() // 2))
    processes = usual if options.processes is None else options.processes
    maker = partial(make, opened, device=options.device, processes=processes)
    missing = opened.missing()
    work = contents(opened.plan, missing) if missing else "nothing is missing"
    print(f"{opened.path}: {work}", flush=True)
    began = time.perf_counter()
    try:
        with Progress("archive", sys.stderr, kernels=kernels) as progress:
            images = fill(opened, maker, progress)
        if images:
            seconds = time.perf_counter() - began
            print(f"{images:,} images in {seconds:.0f} s, {images / seconds:.0f} images/s")
        with Progress("counting markers", sys.stderr) as progress:
            for line in summary(opened.path, check=not options.no_check, progress=progress):
                print(line, flush=True)
    except SessionError as error:
        raise SceneError(f"{error}; {go_on}") from error
    except KeyboardInterrupt:
        print(f"interrupted; written files are kept; {go_on}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (OSError, WorkerLost) as error:
        print(f"stopped: {error}; written files are kept; {go_on}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    return 0


def _solving(options: argparse.Namespace, *, smoke: bool) -> Solving:
    from sim.dataset import Solving

    tier: ContactTier = options.tier or "fem"
    if options.tolerance is not None and options.tier is not None:
        raise SceneError(f"--tier: {options.tier!r} with --tolerance; allowed: either")
    spacing = None if options.spacing is None else metres(options.spacing)
    solving = Solving(tier=tier, spacing=spacing, tolerance=options.tolerance)
    if smoke and spacing is None and tier == "fem" and options.tolerance is None:
        return replace(solving, cells=SMOKE_CELLS, for_edges=False)
    return solving


def _indenters(options: argparse.Namespace, *, smoke: bool) -> tuple[str, ...]:
    from sim.indenters import DRAWN_MOST, NAMES, drawn_name

    if not 0 <= options.drawn <= DRAWN_MOST:
        raise SceneError(f"--drawn: {options.drawn}; allowed: 0 to {DRAWN_MOST}")
    drawn = map(drawn_name, range(options.drawn))
    listed: Sequence[str] | None = options.indenters
    if listed is None:
        return (*(name for name in NAMES if not smoke or name in SMOKE_SHAPES), *drawn)
    if unknown := [name for name in listed if name not in NAMES]:
        raise SceneError(f"--indenters: {', '.join(unknown)}; allowed: {', '.join(NAMES)}")
    return (*(name for name in NAMES if name in listed), *drawn)


def _share(text: str) -> tuple[bool, float]:
    """Return True if `text` requests a smoke sample, and the fraction of the targets."""
    if text in ("smoke", "full"):
        return text == "smoke", SMOKE_SHARE if text == "smoke" else 1.0
    try:
        fraction = float(text)
    except ValueError:
        fraction = -1.0
    if not 0 < fraction <= 1:
        raise SceneError(f"--scale: {text!r}; allowed: smoke, full, or above 0 to 1")
    return False, fraction


def _sensors(options: argparse.Namespace) -> tuple[SimulatedSensor, ...]:
    from sim.sensors import HETEROGENEOUS, HOMOGENEOUS, MATERIAL, sensor, sensor_of

    of_group = dict(zip(GROUPS, (HOMOGENEOUS, MATERIAL, HETEROGENEOUS), strict=True))
    if options.contents in of_group:
        sensors = [sensor(name) for name in of_group[options.contents]]
    else:
        sensors = [sensor_of(name) for name in names(options.contents)]
    if not options.draws:
        return tuple(sensors)
    return tuple(
        drawn
        for twin in sensors
        for drawn in _drawn_sensors(twin, options.draws, options.seed, options.tier)
    )


def _drawn_sensors(
    twin: SimulatedSensor, draws: int, seed: int, tier: str | None
) -> tuple[SimulatedSensor, ...]:
    """Return sensors drawn from the uncertainty of a twin, named after it and numbered."""
    import numpy as np

    from sim.sensors.quantities import draw_sensor

    if twin.posterior is None:
        raise SceneError(
            f"--draws: {twin.name} has no posterior; allowed: files that `tactile twin fit` wrote"
        )
    if tier == "layer" != twin.posterior.tier:
        raise SceneError(
            f"--tier: {tier}; {twin.name} was identified by tier {twin.posterior.tier}; allowed: "
            "that"
        )
    random = np.random.default_rng(seed)
    return tuple(
        replace(draw_sensor(twin, twin.posterior, random), name=f"{twin.name}-{index:03d}")
        for index in range(draws)
    )
