"""`python -m learning train-autoencoder`: the marker autoencoder, first stage of training."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from learning.errors import LearningError
from learning.progress import Progress

if TYPE_CHECKING:
    from learning.command import Verbs


def add_to(verbs: Verbs) -> None:
    """The verb and what it does."""
    parser = verbs.add_parser(
        "train-autoencoder",
        help="train the marker autoencoder on any archives",
        description="Trains a network to give back marker images: of archives, and of random "
        "patterns that move as nothing does; without an archive of those alone. train-direct "
        "begins with its encoder, evaluate compares images by its features. Stopped by Ctrl-C, "
        "the same command with --resume goes on. Several GPUs: torchrun --nproc-per-node N -m "
        "learning train-autoencoder ...",
    )
    parser.add_argument("archives", nargs="*", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument(
        "--split",
        action="append",
        default=[],
        type=Path,
        metavar="JSON",
        help="of an archive's presses; one for each, in their order",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")
    parser.add_argument("--preset", default="ours", metavar="NAME", help="or a YAML file (ours)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="over the preset"
    )
    parser.add_argument("--resume", action="store_true", help="go on with the run that is there")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.data.splits import read_split
    from learning.training.run import EXIT_INTERRUPTED, RunFolder, Stop, accelerator, described
    from learning.translation.direct.autoencoder import (
        KIND,
        PRESETS,
        AutoencoderSettings,
        read_images,
    )
    from learning.translation.direct.train_autoencoder import train
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
    data = " ".join(
        f"{archive_fingerprint(archive)} {split.fingerprint}" for archive, split in archives
    )
    launched = accelerator(settings.launch)
    with RunFolder.open(
        options.out,
        KIND,
        settings,
        data or "random patterns",
        options.resume,
        writes=launched.is_main_process,
    ) as run:
        if run.finished:
            print(f"{options.out}: is finished")
            return 0
        print(described(launched), file=sys.stderr)
        reading, steps = Progress("images", sys.stderr), Progress("steps", sys.stderr)
        try:
            images = read_images(
                archives,
                "train",
                most=settings.most_images,
                seed=settings.seed,
                device=launched.device,
                progress=reading,
            )
            validation = read_images(
                archives,
                "validation",
                most=settings.validation_images,
                seed=settings.seed,
                device=launched.device,
            )
            with Stop(lambda line: print(line, file=sys.stderr)) as stop:
                network = train(
                    images, validation, settings, launched, run, stop=stop, progress=steps
                )
        finally:
            reading.close()
            steps.close()
        if stop.agreed(launched):
            print(f"{options.out}: stopped; --resume goes on", file=sys.stderr)
            return EXIT_INTERRUPTED
        run.finish(settings.steps, {"model": network})
    print(f"{options.out}: trained")
    return 0
