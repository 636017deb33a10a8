"""`python -m learning train-field`: train the field translator on a marker archive."""

from __future__ import annotations

import argparse

from learning.command import add_inputs, add_resume, add_sensors, add_settings
from learning.errors import LearningError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains one field translator for all pairs of an archive's sensors: a net "
        "that estimates a sensor's deformation, and a map from one sensor's deformation to "
        "another's. After Ctrl-C, the same command with --resume continues. Several GPUs: "
        "torchrun --nproc-per-node N -m learning train-field ..."
    )
    add_inputs(parser)
    add_settings(parser)
    add_sensors(parser)
    add_resume(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.train_command import Training, open_data, run_training, trained_on
    from learning.translation.field.data import gather_role
    from learning.translation.field.settings import PRESETS, FieldSettings
    from learning.translation.field.train import train_field
    from learning.translation.field.translator import KIND

    settings = read_settings(FieldSettings, PRESETS, options.preset, options.set)
    archive, split = open_data(options)
    sensors = trained_on(options, archive, split)

    def train(training: Training) -> None:
        presses, validation = (
            gather_role(
                archive,
                split,
                sensors,
                role,
                every=settings.every_frame,
                device=training.device,
                progress=training.reading,
            )
            for role in ("train", "validation")
        )
        if presses is None:
            raise LearningError(
                f"{options.split}: found no press to train on; allowed: one or more"
            )
        with training.stop:
            train_field(
                presses,
                settings,
                validation,
                run=training.run,
                accelerator=training.accelerator,
                stopping=training.stopping,
                progress=training.steps,
            )

    data = (
        f"archive {archive_fingerprint(archive)}, split {split.fingerprint}, "
        f"sensors {', '.join(sensors)}"
    )
    return run_training(options, KIND, settings, data, train, reading="frames")
