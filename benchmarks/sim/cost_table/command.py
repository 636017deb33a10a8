"""Measure what errors cost, and check the promises made from it.

`python -m benchmarks cost-table`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sim.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.sim.cost_table.measure import Campaign
    from sim.cli.options import Verbs
    from sim.planner.seconds import Timed

TRAINING_SEED, HELD_OUT_SEED = 1, 2
TRAINING_BATCHES, HELD_OUT_BATCHES = 11, 14
"""Of ten scenes each; viscous ones are a third of them."""
SECONDS_BATCHES = 6


def add_to(verbs: Verbs) -> None:
    """The verb and its options."""
    parser = verbs.add_parser(
        "cost-table",
        help="measure what errors cost, and check the promises made from it; writes a page",
        description="Without an option: the table, the seconds of this device, the check, the "
        "page. Goes on where it was stopped: what is measured stays in --work. On a machine with a "
        "GPU: --device cuda:0 --table --validate --seconds --work DIR; what comes home of DIR is "
        "stored by --take DIR (training.csv, held-out.csv, seconds-cuda.csv: any of them).",
    )
    steps = parser.add_argument_group("steps (all)")
    for name, text in (
        ("table", "errors of every choice on random scenes"),
        ("seconds", "presses timed one by one on --device"),
        (
            "validate",
            "errors on other scenes, and promises held against them",
        ),
        ("page", "draw the page from what is stored"),
    ):
        steps.add_argument(f"--{name}", action="store_true", help=text)
    parser.add_argument(
        "--take", type=Path, metavar="DIR", help="store what was measured elsewhere, draw the page"
    )
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ... (%(default)s)")
    parser.add_argument(
        "--batches",
        type=int,
        metavar="N",
        help=f"batches of ten scenes (table {TRAINING_BATCHES}, check {HELD_OUT_BATCHES}; "
        f"seconds: scenes, {SECONDS_BATCHES})",
    )
    parser.add_argument(
        "--meshes",
        metavar="N,...",
        help="elements that one thickness is long (those of sim.planner.features)",
    )
    parser.add_argument("--reference", type=int, metavar="N", help="the same of the reference (12)")
    parser.add_argument(
        "--seconds-max",
        type=float,
        default=60.0,
        metavar="S",
        help="time no press that is expected to take longer [s] (%(default)s)",
    )
    parser.add_argument(
        "--work",
        type=Path,
        default=Path("build/cost-table"),
        metavar="DIR",
        help="folder that keeps what is measured, batch by batch (%(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs/results/cost-table.md"),
        help="page to write (%(default)s)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Do the steps asked for; the exit code.

    Raises:
        SceneError: An option that means nothing, a device that is not there, or nothing stored.
    """
    from sim.device import ready_device

    names = ("table", "seconds", "validate", "page")
    wanted = [name for name in names if getattr(options, name)] or list(names)
    if options.take is not None:
        _take(options.take)
        _draw(options.out)
        return 0
    if options.batches is not None and options.batches < 1:
        raise SceneError(f"--batches: {options.batches}; allowed: 1 or more")
    if wanted != ["page"]:
        ready_device(options.device)
    if "table" in wanted:
        _measure(options, _training(options), "TRAINING")
    if "seconds" in wanted:
        _time(options)
    if "validate" in wanted:
        _measure(options, _held_out(options), "HELD_OUT")
    if "page" in wanted or "validate" in wanted:
        _draw(options.out)
    return 0


def _training(options: argparse.Namespace) -> Campaign:
    from benchmarks.sim.cost_table.scenes import TRAINING

    return _campaign(options, "training", TRAINING_SEED, TRAINING_BATCHES, TRAINING)


def _held_out(options: argparse.Namespace) -> Campaign:
    from benchmarks.sim.cost_table.scenes import HELD_OUT

    return _campaign(options, "held-out", HELD_OUT_SEED, HELD_OUT_BATCHES, HELD_OUT)


def _campaign(
    options: argparse.Namespace, name: str, seed: int, batches: int, ranges: object
) -> Campaign:
    from benchmarks.sim.cost_table.measure import REFERENCE_CELLS, Campaign
    from sim.planner.features import LADDER

    ladder: tuple[int, ...] = LADDER
    if options.meshes is not None:
        try:
            ladder = tuple(int(part) for part in options.meshes.split(","))
        except ValueError:
            ladder = ()
        if not ladder or not set(ladder) <= set(LADDER):
            allowed = ", ".join(map(str, LADDER))
            raise SceneError(f"--meshes: {options.meshes!r}; allowed: some of {allowed}")
    cells = REFERENCE_CELLS if options.reference is None else options.reference
    if cells <= max(ladder):
        raise SceneError(f"--reference: {cells}; allowed: above {max(ladder)}")
    return Campaign(
        name=name,
        seed=seed,
        batches=options.batches or batches,
        ranges=ranges,  # type: ignore[arg-type]
        device=options.device,
        reference_cells=cells,
        ladder=ladder,
    )


def _measure(options: argparse.Namespace, campaign: Campaign, target: str) -> None:
    from benchmarks.sim.cost_table.measure import measure
    from sim.planner import error_model

    found = measure(campaign, options.work, lambda line: print(line, flush=True))
    path: Path = getattr(error_model, target)
    error_model.write(path, found)
    print(f"{path}: {len(found.rows)} rows written")


def _time(options: argparse.Namespace) -> None:
    from benchmarks.sim.accuracy.campaign import machine
    from benchmarks.sim.cost_table.seconds import time_presses, write
    from sim.planner.seconds import device_kind

    batches = options.batches or SECONDS_BATCHES
    found = time_presses(
        options.device,
        machine(options.device),
        batches,
        options.seconds_max,
        lambda line: print(line, flush=True),
    )
    write(options.work / f"seconds-{device_kind(options.device)}.csv", found)
    _store_seconds(found)


def _store_seconds(found: Sequence[Timed]) -> None:
    """Put presses in the place of those that were timed on the same devices before."""
    from benchmarks.sim.cost_table.seconds import write
    from sim.planner import seconds

    fresh = {one.device for one in found}
    kept = seconds.read() if seconds.STORED.exists() else []
    write(seconds.STORED, [*(one for one in kept if one.device not in fresh), *found])
    print(f"{seconds.STORED}: {len(found)} presses of {', '.join(sorted(fresh))} written")


def _take(folder: Path) -> None:
    """Store the tables and seconds that a folder has."""
    from sim.planner import error_model, seconds

    taken = 0
    for name, target in (("training", error_model.TRAINING), ("held-out", error_model.HELD_OUT)):
        path = folder / f"{name}.csv"
        if path.exists():
            error_model.write(target, error_model.read(path))
            print(f"{target}: from {path}")
            taken += 1
    for path in sorted(folder.glob("seconds-*.csv")):
        _store_seconds(seconds.read(path))
        taken += 1
    if not taken:
        raise SceneError(
            f"--take: {folder} has nothing to take; allowed: a folder with training.csv, "
            "held-out.csv or seconds-DEVICE.csv"
        )


def _draw(path: Path) -> None:
    from benchmarks.sim.cost_table.page import write_page
    from benchmarks.sim.cost_table.validation import validate
    from sim.planner import error_model, seconds
    from sim.planner.error_model import fit

    for stored in (error_model.TRAINING, seconds.STORED):
        if not stored.exists():
            raise SceneError(f"{stored}: not there; allowed: --page once it was measured")
    known = error_model.read(error_model.TRAINING)
    model, timed = fit(known), seconds.read()
    held_out = error_model.read(error_model.HELD_OUT) if error_model.HELD_OUT.exists() else None
    validation = None if held_out is None else validate(model, held_out)
    predicted = seconds.fit_seconds(known, timed)
    write_page(path, known, model, predicted, timed, held_out, validation)
    print(f"{path}: written")
