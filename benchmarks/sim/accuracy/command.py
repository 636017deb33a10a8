"""Error, time and memory of every solver and setting.

`python -m benchmarks accuracy` writes docs/results/accuracy.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_device, whole
from sim.errors import SceneError

if TYPE_CHECKING:
    from benchmarks.sim.accuracy.competitors import Competitor

SMOKE_CASES, SMOKE_COMPETITORS = ("sphere",), ("layer", "fem fineness 0.5", "fem even 1.25 mm")
# Fineness of the reference mesh with --smoke.
SMOKE_REFERENCE = 0.8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Measures into one file per device, resumes an interrupted run, and draws the "
        "page from all files. On a machine with a GPU: --device cuda:0 --only measure "
        "--out DIR; copy the file here and --only page includes it."
    )
    add_device(parser)
    parser.add_argument("--only", choices=("measure", "page"), help="run this step only (both)")
    parser.add_argument(
        "--case", action="append", default=[], metavar="NAME", help="this case only (repeatable)"
    )
    parser.add_argument(
        "--reference",
        type=float,
        metavar="FINENESS",
        help="fineness of the reference meshes, which are cached (that of each case)",
    )
    parser.add_argument(
        "--processes",
        type=whole(),
        default=1,
        metavar="N",
        help="processes that solve the references beside a GPU (%(default)s)",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=20.0,
        metavar="S",
        help="skip meshes that are expected to take longer [s] (%(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs/results/accuracy"),
        metavar="DIR",
        help="folder of the measurements; the page is DIR.md (%(default)s)",
    )
    parser.add_argument(
        "--references",
        type=Path,
        default=Path("build/accuracy"),
        metavar="DIR",
        help="folder of cached references (%(default)s)",
    )
    parser.add_argument(
        "--smoke", action="store_true", help="one case on coarse meshes: seconds, not minutes"
    )


def run(options: argparse.Namespace) -> int:
    """Measure missing rows, draw the page, and return the exit code.

    Raises:
        SceneError: Unknown case or device, or no measurements to draw.
    """
    if options.only != "page":
        _measure(options)
    if options.only != "measure":
        _draw(options.out)
    return 0


def _measure(options: argparse.Namespace) -> None:
    from benchmarks.sim.accuracy.campaign import AccuracyCampaign, measure
    from benchmarks.sim.accuracy.cases import chosen
    from benchmarks.sim.accuracy.competitors import competitors
    from sim.device import ready_device

    ready_device(options.device)
    if options.reference is not None and not options.reference > 0:
        raise SceneError(f"--reference: {options.reference!r}; allowed: above 0")
    names = tuple(options.case) or (SMOKE_CASES if options.smoke else ())
    try:
        cases = chosen(names)
    except ValueError as error:
        raise SceneError(f"--case: {error}") from error
    chosen_competitors: list[Competitor] = competitors()
    fineness = options.reference
    if options.smoke:
        chosen_competitors = [one for one in chosen_competitors if one.name in SMOKE_COMPETITORS]
        fineness = SMOKE_REFERENCE
    plan = AccuracyCampaign(
        device=options.device,
        cases=cases,
        competitors=tuple(chosen_competitors),
        fineness=fineness,
        seconds_max=options.seconds,
        cache=options.references,
        processes=options.processes,
    )
    path = options.out / f"{options.device.replace(':', '-')}.jsonl"
    measure(plan, path, lambda line: print(line, flush=True))
    print(f"{path}: written")


def _draw(folder: Path) -> None:
    from benchmarks.sim.accuracy.page import write_page
    from benchmarks.sim.accuracy.row import read

    files = sorted(folder.glob("*.jsonl"))
    if not files:
        raise SceneError(f"--out: no measurements in {folder}; allowed: a folder with measurements")
    page = folder.with_suffix(".md")
    write_page(page, folder, [read(path) for path in files])
    print(f"{page}: written")
