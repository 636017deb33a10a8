"""`python -m learning train-marker-vae`: SD-Turbo's autoencoder learns to draw markers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from learning.progress import Progress

if TYPE_CHECKING:
    from learning.command import Verbs


def add_to(verbs: Verbs) -> None:
    """The verb and what it does."""
    parser = verbs.add_parser(
        "train-marker-vae",
        help="train the autoencoder of the paper's translator, before that",
        description="Trains the adapter of SD-Turbo's autoencoder on the frames of all sensors of "
        "an archive. Stopped by Ctrl-C, the same command with --resume goes on.",
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--split", type=Path, required=True, metavar="JSON", help="of its presses")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")
    parser.add_argument(
        "--preset",
        default="ours",
        metavar="NAME",
        help="paper_main, paper_supplement, authors_code, ours, or a YAML file (%(default)s)",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="over the preset"
    )
    parser.add_argument("--base", metavar="DIR", help="SD-Turbo: unet/, vae/ (weights.base)")
    parser.add_argument(
        "--sensors", metavar="NAME,...", help="learn from these (all that are not held out)"
    )
    parser.add_argument("--resume", action="store_true", help="go on with the run that is there")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    import json

    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.data.splits import read_split
    from learning.training.run import EXIT_INTERRUPTED, RunFolder, Stop, accelerator, described
    from learning.translation.diffusion.data import read_role_images
    from learning.translation.diffusion.settings import MARKER_VAE_PRESETS, MarkerVaeSettings
    from learning.translation.diffusion.train_vae import train_vae
    from learning.translation.diffusion.translator import BASE, MARKER_VAE
    from learning.translation.diffusion.weights import fingerprint, read_vae, require_base_folder
    from recorder import MarkerArchive

    given = [] if options.base is None else [f"weights.base={json.dumps(options.base)}"]
    settings = read_settings(
        MarkerVaeSettings, MARKER_VAE_PRESETS, options.preset, [*options.set, *given]
    )
    archive, split = MarkerArchive(options.archive), read_split(options.split)
    split.check(archive)
    sensors = options.sensors.split(",") if options.sensors else split.trained_sensors(archive)
    require_base_folder(settings.weights.base)
    base = fingerprint(settings.weights.base)
    runs_on = accelerator(settings.launch)
    data = ["archive", archive_fingerprint(archive), split.fingerprint, *sensors, base]
    with RunFolder.open(
        options.out,
        MARKER_VAE,
        settings,
        " ".join(data),
        options.resume,
        facts={BASE: base},
        writes=runs_on.is_main_process,
    ) as run:
        if run.finished:
            print(f"{options.out}: is finished")
            return 0
        print(described(runs_on), file=sys.stderr)
        reading, steps = Progress("images", sys.stderr), Progress("steps", sys.stderr)
        images, validation = (
            read_role_images(
                archive, split, role, sensors=sensors, device=runs_on.device, progress=reading
            )
            for role in ("train", "validation")
        )
        print(f"{len(images):,} images of {', '.join(sensors)}", file=sys.stderr)
        try:
            with Stop(lambda line: print(line, file=sys.stderr)) as stop:
                train_vae(
                    images,
                    read_vae(settings.weights.base),
                    settings,
                    validation=validation if len(validation) else None,
                    run=run,
                    accelerator=runs_on,
                    stopping=lambda: stop.asked,
                    progress=steps,
                )
        finally:
            steps.close()
        if stop.asked and not run.finished:
            print(f"{options.out}: stopped; --resume goes on", file=sys.stderr)
            return EXIT_INTERRUPTED
    print(f"{options.out}: trained")
    return 0
