"""`python -m learning train-field`: train the field translator on a marker archive."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from learning.command import add_inputs, add_resume, add_sensors, add_settings

if TYPE_CHECKING:
    from learning.command import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the verb and its options."""
    parser = subcommands.add_parser(
        "train-field",
        description="Trains one field translator for all pairs of an archive's sensors: a net "
        "that estimates a sensor's deformation, and a map from one sensor's deformation to "
        "another's. After Ctrl-C, the same command with --resume continues. Several GPUs: "
        "torchrun --nproc-per-node N -m learning train-field ...",
    )
    add_inputs(parser)
    add_settings(parser)
    add_sensors(parser)
    add_resume(parser)
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.translation.field.train import run

    return run(options)
