"""`python -m learning train-direct`: the direct translator, pretrained and then fine-tuned."""

from __future__ import annotations

import argparse
import functools
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from learning.errors import LearningError
from learning.progress import Progress

if TYPE_CHECKING:
    from learning.command import Verbs
    from learning.translation.direct.network import DirectNetwork
    from learning.translation.direct.settings import DirectSettings


def add_to(verbs: Verbs) -> None:
    """The verb and what it does."""
    parser = verbs.add_parser(
        "train-direct",
        help="train the direct translator on a group of sensors",
        description="Trains one network for all pairs of an archive's sensors, on location pairs. "
        "As in the paper: first on simulated states with the encoder of an autoencoder "
        "(--autoencoder), then from there on each group of sensors (--from). Stopped by Ctrl-C, "
        "the same command with --resume goes on. Several GPUs: torchrun --nproc-per-node N -m "
        "learning train-direct ...",
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--split", type=Path, required=True, metavar="JSON", help="of its presses")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")
    start = parser.add_mutually_exclusive_group(required=True)
    start.add_argument(
        "--autoencoder", type=Path, metavar="RUN", help="begin anew, with this one's encoder"
    )
    start.add_argument(
        "--from", dest="start", type=Path, metavar="RUN", help="begin with this translator"
    )
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
    from learning.translation.direct.data import align, group
    from learning.translation.direct.settings import PRESETS, DirectSettings
    from learning.translation.direct.train import train
    from learning.translation.direct.translator import KIND
    from recorder import MarkerArchive

    settings = read_settings(DirectSettings, PRESETS, options.preset, options.set)
    archive, split = MarkerArchive(options.archive), read_split(options.split)
    sensors = group(archive, split, options.sensors.split(",") if options.sensors else None)
    if not len(split.locations("train")):
        raise LearningError(f"{options.split}: found no location to train on")
    network, mark = _begun(options, settings)
    data = " ".join([archive_fingerprint(archive), split.fingerprint, mark, *sensors])
    launched = accelerator(settings.launch)
    with RunFolder.open(
        options.out, KIND, settings, data, options.resume, writes=launched.is_main_process
    ) as run:
        if run.finished:
            print(f"{options.out}: is finished")
            return 0
        print(described(launched), file=sys.stderr)
        reading, steps = Progress("images", sys.stderr), Progress("steps", sys.stderr)
        try:
            gather = functools.partial(
                align,
                archive,
                split,
                sensors=sensors,
                preset=settings.pairs,
                device=launched.device,
            )
            training = gather("train", progress=reading)
            measured = len(split.locations("validation")) > 0
            validation = gather("validation", fields=False) if measured else None
            with Stop(lambda line: print(line, file=sys.stderr)) as stop:
                trained = train(
                    network,
                    training,
                    validation,
                    settings,
                    launched,
                    run,
                    stop=stop,
                    progress=steps,
                )
        finally:
            reading.close()
            steps.close()
        if stop.agreed(launched):
            print(f"{options.out}: stopped; --resume goes on", file=sys.stderr)
            return EXIT_INTERRUPTED
        run.finish(settings.steps, {"model": trained}, facts={"sensors": list(training.sensors)})
    print(f"{options.out}: trained")
    return 0


def _begun(options: argparse.Namespace, settings: DirectSettings) -> tuple[DirectNetwork, str]:
    """Return the network to start from, and the hash of the weights that it has."""
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
