"""`tactile train direct`: pretrain or fine-tune the direct translator."""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.command import add_inputs, add_resume, add_sensors, add_settings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains one network for all pairs of an archive's sensors, on location pairs. "
        "As in the paper: first on simulated states with the encoder of an autoencoder "
        "(--autoencoder), then from there on each group of sensors (--from). After Ctrl-C, "
        "the same command with --resume continues. Several GPUs: torchrun --nproc-per-node N -m "
        "train direct ..."
    )
    add_inputs(parser)
    start = parser.add_mutually_exclusive_group(required=True)
    start.add_argument(
        "--autoencoder",
        type=Path,
        metavar="RUN",
        help="train from scratch with the encoder of this autoencoder",
    )
    start.add_argument(
        "--from", dest="start", type=Path, metavar="RUN", help="start from this translator"
    )
    add_settings(parser)
    add_sensors(parser)
    add_resume(parser)


def run(options: argparse.Namespace) -> int:
    """Train, and return the exit code."""
    from learning.translation.direct.train import run as train

    return train(options)
