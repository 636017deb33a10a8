"""`python -m learning train-field`: the learned field translator, trained on a marker archive."""

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
        "train-field",
        help="train the field translator on a group of sensors",
        description="Trains one field translator for all pairs of an archive's sensors: a net "
        "that sees how a sensor is deformed, and a map from each sensor's deformation to each "
        "other's. Stopped by Ctrl-C, the same command with --resume goes on. Several GPUs: "
        "torchrun --nproc-per-node N -m learning train-field ...",
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--split", type=Path, required=True, metavar="JSON", help="of its presses")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")
    parser.add_argument("--preset", default="ours", metavar="NAME", help="or a YAML file (ours)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="over the preset"
    )
    parser.add_argument(
        "--sensors", metavar="NAME,...", help="learn from these (all that are not held out)"
    )
    parser.add_argument("--resume", action="store_true", help="go on with the run that is there")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.data.splits import read_split
    from learning.training.run import EXIT_INTERRUPTED, RunFolder, Stop, accelerator, described
    from learning.translation.field.data import gather_role
    from learning.translation.field.settings import PRESETS, FieldSettings
    from learning.translation.field.train import train_field
    from learning.translation.field.translator import KIND
    from recorder import MarkerArchive

    settings = read_settings(FieldSettings, PRESETS, options.preset, options.set)
    archive, split = MarkerArchive(options.archive), read_split(options.split)
    split.check(archive)
    sensors = split.trained_sensors(archive)
    if options.sensors:
        sensors = tuple(options.sensors.split(","))
    runs_on = accelerator(settings.launch)
    data = (
        f"archive {archive_fingerprint(archive)}, split {split.fingerprint}, "
        f"sensors {', '.join(sensors)}"
    )
    with RunFolder.open(
        options.out, KIND, settings, data, options.resume, writes=runs_on.is_main_process
    ) as run:
        if run.finished:
            print(f"{options.out}: is finished")
            return 0
        print(described(runs_on), file=sys.stderr)
        reading, steps = Progress("frames", sys.stderr), Progress("steps", sys.stderr)
        training, validation = (
            gather_role(
                archive,
                split,
                sensors,
                role,
                every=settings.every_frame,
                device=runs_on.device,
                progress=reading,
            )
            for role in ("train", "validation")
        )
        if training is None:
            raise LearningError(f"{options.split}: found no press to train on; allowed: some")
        try:
            with Stop(lambda line: print(line, file=sys.stderr)) as stop:
                train_field(
                    training,
                    settings,
                    validation,
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
