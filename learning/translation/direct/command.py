"""`python -m learning train-direct`: pretrain or fine-tune the direct translator."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import add_inputs, add_resume, add_sensors, add_settings

if TYPE_CHECKING:
    from learning.command import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the verb and its options."""
    parser = subcommands.add_parser(
        "train-direct",
        description="Trains one network for all pairs of an archive's sensors, on location pairs. "
        "As in the paper: first on simulated states with the encoder of an autoencoder "
        "(--autoencoder), then from there on each group of sensors (--from). After Ctrl-C, "
        "the same command with --resume continues. Several GPUs: torchrun --nproc-per-node N -m "
        "learning train-direct ...",
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
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.translation.direct.train import run

    return run(options)
