"""`tactile train field`: train the field translator on a marker archive."""

import argparse

from learning.command import add_inputs, add_sensors, add_settings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains one field translator for all pairs of an archive's sensors: a net "
        "that estimates a sensor's deformation, and a map from one sensor's deformation to "
        "another's. After Ctrl-C, the same command continues. Several GPUs: "
        "torchrun --nproc-per-node N -m tactile train field ..."
    )
    add_inputs(parser)
    add_settings(parser)
    add_sensors(parser)


def run(options: argparse.Namespace) -> int:
    """Train, and return the exit code."""
    from learning.translation.field.train import run as train

    return train(options)
