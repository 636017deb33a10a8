"""`python -m learning experiment`: translate, train, compensate and evaluate pairs of sensors."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import add_settings

if TYPE_CHECKING:
    from learning.command import Verbs


def add_to(verbs: Verbs) -> None:
    """Add the verb and its options."""
    parser = verbs.add_parser(
        "experiment",
        description="Carries forces from each sensor of an archive to each other: trains the "
        "translators, a force model for each source, one for each pair on translated frames, and "
        "reports what they predict of presses that none of them saw, before and after. Stopped "
        "at any moment, the same command goes on.",
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for all")
    add_settings(parser, "demo")
    parser.add_argument("--pairs", metavar="A:B,...", help="from A to B (all directed pairs)")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="cpu, cuda:0, ... (cpu)")
    parser.add_argument(
        "--processes",
        type=int,
        default=os.cpu_count() or 1,
        metavar="N",
        help="that follow markers (all cores)",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="models trained side by side, as long as the memory holds them (1)",
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.config import read_settings
    from learning.experiment.running import gained, run_experiment
    from learning.experiment.settings import PRESETS, ExperimentSettings

    settings = read_settings(ExperimentSettings, PRESETS, options.preset, options.set)
    report = run_experiment(
        options.archive,
        options.out,
        settings,
        pairs=options.pairs.split(",") if options.pairs else None,
        device=options.device,
        processes=options.processes,
        jobs=options.jobs,
        say=lambda line: print(line, flush=True),
    )
    for line in report.lines:
        print(line)
    print(f"{report.files[0]}: written, beside {len(report.files) - 1} tables")
    print(gained(report.force))
    return 0
