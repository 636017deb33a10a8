"""`tactile experiment`: translate, train, compensate and evaluate pairs of sensors."""

import argparse
import os
from pathlib import Path

from learning.command import add_settings
from recorder.command_line.options import add_device, names


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Transfers force sensing between the sensors of an archive: trains the "
        "translators, a force model for each source and one for each pair on translated frames, "
        "then reports their errors on held-out presses, before and after the transfer. An "
        "interrupted experiment continues when the command is repeated."
    )
    add = parser.add_argument
    add("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    add("--out", type=Path, required=True, metavar="DIR", help="result folder")
    add_settings(parser, "demo")
    add("--pairs", type=names, metavar="A:B,...", help="pairs from A to B (all directed pairs)")
    add_device(parser)
    about = "processes that track markers (all cores)"
    add("--processes", type=int, default=os.cpu_count() or 1, metavar="N", help=about)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.config import preset_path, read_settings
    from learning.experiment.running import gained, run_experiment
    from learning.experiment.settings import PRESETS, ExperimentSettings
    from learning.experiment.stages import Places

    settings = read_settings(ExperimentSettings, PRESETS, options.preset, options.set)
    report = run_experiment(
        Places(options.out, options.archive),
        settings,
        pairs=options.pairs,
        device=options.device,
        processes=options.processes,
        say=lambda line: print(line, flush=True),
        where=str(preset_path(PRESETS, options.preset)),
    )
    for line in report.lines:
        print(line)
    print(f"{report.files[0]}: written, beside {len(report.files) - 1} tables")
    print(gained(report.force))
    return 0
