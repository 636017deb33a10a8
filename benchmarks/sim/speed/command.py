"""Timing of the paper's presses, and the gain of each optimisation.

`python -m benchmarks speed` writes docs/results/speed.md.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_device
from sim.cli.options import metres
from sim.errors import SceneError

if TYPE_CHECKING:
    from sim.mpm import Mpm

# Parts to measure; `page` draws.
PARTS = ("presses", "scaling", "steps", "mpm", "meshes", "reference")
# Other element heights with which the presses are timed [m].
MESHES = (4e-3 / 3, 1e-3, 4e-3 / 6)
# Element sizes with --smoke [mm].
SMOKE_SPACING, SMOKE_REFERENCE, SMOKE_MESHES = 4 / 3, 1.0, (1e-3,)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Measures into one file per device, resumes an interrupted run, and writes the "
        "page from all files. On a machine with a GPU: --device cuda:0 --only "
        f"{','.join(PARTS)} --out DIR; copy its files here and --only page includes them."
    )
    add_device(parser)
    parser.add_argument(
        "--processes", type=int, metavar="N", help="processes on a CPU (2); a GPU uses one"
    )
    parser.add_argument(
        "--spacing",
        type=float,
        default=0.8,
        metavar="MM",
        help="element height of the timed presses [mm] (%(default)s)",
    )
    parser.add_argument(
        "--reference",
        type=float,
        default=0.4,
        metavar="MM",
        help="element height of the reference [mm] (%(default)s); on a CPU it takes hours",
    )
    parser.add_argument(
        "--only",
        metavar="PART,...",
        help=f"some of {', '.join(PARTS)}, page (all; on a CPU without meshes and reference)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs/results/speed"),
        metavar="DIR",
        help="folder of the measurements; the page is DIR.md (%(default)s)",
    )
    parser.add_argument("--again", action="store_true", help="measure existing runs again")
    parser.add_argument("--long", action="store_true", help="also all 810 presses on a CPU")
    parser.add_argument(
        "--smoke", action="store_true", help="a few presses on coarse meshes: seconds, not minutes"
    )


def run(options: argparse.Namespace) -> int:
    """Measure missing runs, write the page, and return the exit code.

    Raises:
        SceneError: Unknown part or device, or no measurements to draw.
    """
    parts = _parts(options)
    measured = tuple(part for part in PARTS if part in parts)
    if measured:
        _measure(options, measured)
    if "page" in parts:
        _draw(options.out)
    return 0


def _parts(options: argparse.Namespace) -> set[str]:
    allowed = (*PARTS, "page")
    if options.only is None:
        # A first run should not begin with parts that take hours.
        hours = {"meshes", "reference"} if _cpu(options) and not options.smoke else set()
        return set(allowed) - hours
    parts = set(options.only.split(","))
    if not parts <= set(allowed):
        raise SceneError(f"--only: {options.only!r}; allowed: some of {', '.join(allowed)}")
    return parts


def _cpu(options: argparse.Namespace) -> bool:
    return bool(options.device == "cpu")


def _measure(options: argparse.Namespace, parts: tuple[str, ...]) -> None:
    from benchmarks.sim.speed.campaign import SpeedCampaign, measure
    from benchmarks.sim.speed.work import paper_work, smoke_work
    from sim.device import ready_device
    from sim.tiers import check_processes

    processes = options.processes
    if processes is None:
        processes = 2 if _cpu(options) else 1
    check_processes(processes)
    if processes > 1 and not _cpu(options):
        raise SceneError(
            f"--processes: {processes} on device {options.device!r}; allowed: 1, or device 'cpu'"
        )
    kernels = ready_device(options.device)
    for name in ("spacing", "reference"):
        value = getattr(options, name)
        if not (math.isfinite(value) and value > 0):
            raise SceneError(f"--{name}: {value!r} mm; allowed: above 0")
    plan = SpeedCampaign(
        device=options.device,
        work=smoke_work() if options.smoke else paper_work(),
        folder=options.out,
        parts=parts,
        processes=processes,
        spacing=metres(SMOKE_SPACING if options.smoke else options.spacing),
        meshes=SMOKE_MESHES if options.smoke else MESHES,
        reference_spacing=metres(SMOKE_REFERENCE if options.smoke else options.reference),
        again=options.again,
        long=options.long,
        kernels=kernels,
        mpm=_presets(options.smoke),
    )
    measure(plan, lambda line: print(line, flush=True))
    print(f"{plan.file}: written")


def _presets(smoke: bool) -> dict[str, Mpm]:
    from sim.mpm import Mpm

    if smoke:
        return {"coarse": Mpm(cell=2e-3)}
    return {"ours": Mpm(), "as the authors have it": Mpm.authors()}


def _draw(folder: Path) -> None:
    from benchmarks.sim.speed.page import write_page
    from benchmarks.sim.speed.record import read

    files = sorted(folder.glob("*.jsonl"))
    if not files:
        raise SceneError(f"--out: no measurements in {folder}; allowed: a folder with measurements")
    page = folder.with_suffix(".md")
    write_page(page, [read(path) for path in files])
    print(f"{page}: written")
