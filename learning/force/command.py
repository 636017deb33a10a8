"""`tactile train force`: train a force model on presses with force labels."""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.command import add_resume, add_settings, add_split
from recorder.command_line.options import names


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains a model of Fx, Fy, Fz [N] on sequences of marker images of a sensor, "
        "or of a translated one (A-to-B). Ctrl-C saves a checkpoint; --resume continues from it."
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument(
        "--sensor", type=names, metavar="NAME,...", required=True, help="sensors to train on"
    )
    add_split(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="the run's folder")
    add_settings(
        parser,
        "tiny",
        "a preset, or your own YAML file (tiny)",
        example="e.g. sequences.batch=32",
    )
    parser.add_argument(
        "--start-from", type=Path, metavar="MODEL", help="start from the weights of this model"
    )
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="CSV",
        help="labels in place of the archive's, as readings typed in: columns indenter, target, "
        "frame (none: where the press is held), fx_n, fy_n, fz_n [N]",
    )
    parser.add_argument(
        "--compensation",
        type=Path,
        metavar="FILE",
        help="compensate labels for another material; with --choice simulated, the archive of the "
        "pair's target, if it is another",
    )
    parser.add_argument(
        "--pair", metavar="A-to-B", help="the compensated pair (default: that of --sensor)"
    )
    parser.add_argument(
        "--choice",
        default="default",
        metavar="NAME",
        help="its choice of d0 and lambda (default); simulated: by forces of twins (tactile sim "
        "labels) of both sensors of the pair, or those of the sensor's own twin",
    )
    add_resume(parser, "continue the run in --out")


def run(options: argparse.Namespace) -> int:
    """Train, and return the exit code."""
    from learning.force.train import run as train

    return train(options)
