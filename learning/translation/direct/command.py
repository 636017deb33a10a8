"""`python -m learning train-direct`: pretrain or fine-tune the direct translator."""

from __future__ import annotations

import argparse
import functools
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import add_inputs, add_resume, add_sensors, add_settings
from learning.errors import LearningError

if TYPE_CHECKING:
    from learning.translation.direct.network import DirectNetwork
    from learning.translation.direct.settings import DirectSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains one network for all pairs of an archive's sensors, on location pairs. "
        "As in the paper: first on simulated states with the encoder of an autoencoder "
        "(--autoencoder), then from there on each group of sensors (--from). After Ctrl-C, "
        "the same command with --resume continues. Several GPUs: torchrun --nproc-per-node N -m "
        "learning train-direct ..."
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
    """Run the command and return the exit code."""
    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.train_command import Training, open_data, run_training
    from learning.translation.direct.data import align, group
    from learning.translation.direct.settings import PRESETS, DirectSettings
    from learning.translation.direct.train import train as train_network
    from learning.translation.direct.translator import KIND

    settings = read_settings(DirectSettings, PRESETS, options.preset, options.set)
    archive, split = open_data(options)
    sensors = group(archive, split, options.sensors)
    if not len(split.locations("train")):
        raise LearningError(f"{options.split}: found no location to train on")
    network, mark = _begun(options, settings)

    def train(training: Training) -> None:
        gather = functools.partial(
            align,
            archive,
            split,
            sensors=sensors,
            preset=settings.pairs,
            device=training.device,
        )
        images = gather("train", progress=training.reading)
        measured = len(split.locations("validation")) > 0
        validation = gather("validation", fields=False) if measured else None
        with training.stop:
            trained = train_network(
                network,
                images,
                validation,
                settings,
                training.accelerator,
                training.run,
                stop=training.stop,
                progress=training.steps,
            )
        if not training.stop.agreed(training.accelerator):
            facts = {"sensors": list(images.sensors)}
            training.run.finish(settings.steps, {"model": trained}, facts=facts)

    data = " ".join([archive_fingerprint(archive), split.fingerprint, mark, *sensors])
    return run_training(options, KIND, settings, data, train)


def _begun(options: argparse.Namespace, settings: DirectSettings) -> tuple[DirectNetwork, str]:
    """Return the initial network, and the hash of its source's weights."""
    from learning.training.checkpoint import read_model_folder
    from learning.translation.direct.autoencoder import load_autoencoder
    from learning.translation.direct.train import new_network
    from learning.translation.direct.translator import load_network

    folder = options.start or options.autoencoder
    mark = read_model_folder(folder).hash()
    if options.start is None:
        autoencoder = load_autoencoder(folder)
        return new_network(settings, autoencoder.encoder), mark
    network, before = load_network(folder)
    for name, wanted in settings.structure.items():
        found = before.structure[name]
        if wanted != found:
            raise LearningError(f"{name}: found {wanted}; {folder} allows {found} alone")
    return network, mark
