"""`python -m learning train-marker-vae`: train SD-Turbo's autoencoder on marker images."""

from __future__ import annotations

import argparse
import sys

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
    """Run the command and return the exit code."""
    import json

    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.train_command import Training, open_data, run_training, trained_on
    from learning.translation.diffusion.data import read_role_images
    from learning.translation.diffusion.settings import MARKER_VAE_PRESETS, MarkerVaeSettings
    from learning.translation.diffusion.train_vae import train_vae
    from learning.translation.diffusion.translator import BASE, MARKER_VAE
    from learning.translation.diffusion.weights import fingerprint, read_vae, require_base_folder

    given = [] if options.base is None else [f"weights.base={json.dumps(options.base)}"]
    settings = read_settings(
        MarkerVaeSettings, MARKER_VAE_PRESETS, options.preset, [*options.set, *given]
    )
    archive, split = open_data(options)
    sensors = trained_on(options, archive, split)
    require_base_folder(settings.weights.base)
    base = fingerprint(settings.weights.base)

    def train(training: Training) -> None:
        images, validation = (
            read_role_images(
                archive,
                split,
                role,
                sensors=sensors,
                device=training.device,
                progress=training.reading,
            )
            for role in ("train", "validation")
        )
        print(f"{len(images):,} images of {', '.join(sensors)}", file=sys.stderr)
        with training.stop:
            train_vae(
                images,
                read_vae(settings.weights.base),
                settings,
                validation=validation if len(validation) else None,
                run=training.run,
                accelerator=training.accelerator,
                stopping=training.stopping,
                progress=training.steps,
            )

    data = " ".join(["archive", archive_fingerprint(archive), split.fingerprint, *sensors, base])
    return run_training(options, MARKER_VAE, settings, data, train, facts={BASE: base})
