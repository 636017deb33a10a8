"""`tactile train autoencoder`: train the marker autoencoder, the first stage."""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.command import add_resume, add_run, add_settings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains a network to reconstruct marker images of archives and of random "
        "patterns under made-up deformations; without an archive only the latter. train direct "
        "starts from its encoder, evaluate compares images by its features. After Ctrl-C, "
        "the same command with --resume continues. Several GPUs: torchrun --nproc-per-node N -m "
        "train autoencoder ..."
    )
    parser.add_argument("archives", nargs="*", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument(
        "--split",
        action="append",
        default=[],
        type=Path,
        metavar="JSON",
        help="split of an archive's presses; one per archive, in the same order",
    )
    add_run(parser)
    add_settings(parser)
    add_resume(parser)


def run(options: argparse.Namespace) -> int:
    """Train, and return the exit code."""
    from learning.translation.direct.train_autoencoder import run as train

    return train(options)
