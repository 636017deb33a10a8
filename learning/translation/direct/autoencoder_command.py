"""`python -m learning train-autoencoder`: train the marker autoencoder, the first stage."""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.command import add_resume, add_run, add_settings
from learning.errors import LearningError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains a network to reconstruct marker images of archives and of random "
        "patterns under made-up deformations; without an archive only the latter. train-direct "
        "starts from its encoder, evaluate compares images by its features. After Ctrl-C, "
        "the same command with --resume continues. Several GPUs: torchrun --nproc-per-node N -m "
        "learning train-autoencoder ..."
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
    """Run the command and return the exit code."""
    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.data.splits import read_split
    from learning.train_command import Training, run_training
    from learning.translation.direct.autoencoder import (
        KIND,
        PRESETS,
        AutoencoderSettings,
        read_images,
    )
    from learning.translation.direct.train_autoencoder import train as train_network
    from recorder import MarkerArchive

    settings = read_settings(AutoencoderSettings, PRESETS, options.preset, options.set)
    if len(options.split) != len(options.archives):
        raise LearningError(
            f"--split: found {len(options.split)} for {len(options.archives)} archives; allowed: "
            "one for each"
        )
    archives = [
        (MarkerArchive(path), read_split(split))
        for path, split in zip(options.archives, options.split, strict=True)
    ]

    def train(training: Training) -> None:
        images = read_images(
            archives,
            "train",
            most=settings.most_images,
            seed=settings.seed,
            device=training.device,
            progress=training.reading,
        )
        validation = read_images(
            archives,
            "validation",
            most=settings.validation_images,
            seed=settings.seed,
            device=training.device,
        )
        with training.stop:
            network = train_network(
                images,
                validation,
                settings,
                training.accelerator,
                training.run,
                stop=training.stop,
                progress=training.steps,
            )
        if not training.stop.agreed(training.accelerator):
            training.run.finish(settings.steps, {"model": network})

    data = " ".join(
        f"{archive_fingerprint(archive)} {split.fingerprint}" for archive, split in archives
    )
    return run_training(options, KIND, settings, data or "random patterns", train)
