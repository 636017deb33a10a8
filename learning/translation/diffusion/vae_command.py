"""`tactile train marker-vae`: train SD-Turbo's autoencoder on marker images."""

from __future__ import annotations

import argparse

from learning.command import add_inputs, add_resume, add_sensors, add_settings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains the adapter of SD-Turbo's autoencoder on the frames of all sensors of "
        "an archive. After Ctrl-C, the same command with --resume continues."
    )
    add_inputs(parser)
    add_settings(
        parser,
        known="paper_main, paper_supplement, authors_code, ours, or a YAML file (%(default)s)",
    )
    parser.add_argument("--base", metavar="DIR", help="SD-Turbo: unet/, vae/ (weights.base)")
    add_sensors(parser)
    add_resume(parser)


def run(options: argparse.Namespace) -> int:
    """Train, and return the exit code."""
    from learning.translation.diffusion.train_vae import run as train

    return train(options)
