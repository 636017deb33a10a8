"""`tactile cross-validate`: score a force model on indenters that it never saw."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from learning.command import add_settings
from learning.errors import LearningError
from recorder.progress import ItemProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Leaves each indenter of a sensor out in turn, trains a force model on the others, "
        "predicts the one left out, and writes a report. For shading a ridge regression on 11 "
        "features of colours stands beside the model."
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr with labels")
    parser.add_argument("--sensor", metavar="NAME", help="its sensor (the only one)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="report folder")
    add_settings(parser, "", "a preset, or a YAML file (shading for shading, else tiny)")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.config import read_settings
    from learning.evaluation.predictions import Predictions
    from learning.evaluation.report import write_report
    from learning.experiment.cross_validation import folds
    from learning.force.train import PRESETS, ForceSettings
    from recorder import MarkerArchive
    from recorder.archive import SHADING

    archive = MarkerArchive(options.archive)
    sensor = options.sensor or (next(iter(archive)) if len(archive) == 1 else None)
    if sensor is None or sensor not in archive:
        raise LearningError(f"--sensor: found {options.sensor!r}; known: {', '.join(archive)}")
    usual = "shading" if archive[sensor].representation == SHADING else "tiny"
    settings = read_settings(ForceSettings, PRESETS, options.preset or usual, options.set)
    options.out.mkdir(parents=True, exist_ok=True)
    found: list[Predictions] = []
    with ItemProgress("indenters", sys.stderr) as progress:
        for fold in folds(archive, sensor, settings, progress):
            print(fold, flush=True)
            found += fold.predictions
            for one in fold.predictions:
                indenter = fold.indenter.replace("/", "_")
                one.write(options.out / f"{sensor}.{indenter}.{one.method}.npz")
    report = write_report(found, [], options.out, title=f"{sensor}: indenters never seen")
    for line in report.lines:
        print(line)
    print(f"{report.files[0]}: written, beside {len(report.files) - 1} tables")
    return 0
