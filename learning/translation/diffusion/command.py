"""`python -m learning train-diffusion`: train the paper's translator on a marker archive."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import add_resume, add_sensors, add_settings
from learning.errors import LearningError

if TYPE_CHECKING:
    from learning.translation.diffusion.settings import TranslatorSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains one translator for all pairs of an archive's sensors, from published "
        "weights that you supply: SD-Turbo, CLIP ViT-B/32, VGG16, LPIPS. After Ctrl-C, the same "
        "command with --resume continues. Several GPUs: torchrun --nproc-per-node N -m learning "
        "..."
    )
    parser.add_argument("archive", nargs="?", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--split", type=Path, metavar="JSON", help="split of its presses")
    parser.add_argument("--out", type=Path, metavar="RUN", help="folder of the run")
    add_settings(
        parser,
        known="paper_main, paper_supplement, authors_code, ours, or a YAML file (%(default)s)",
    )
    parser.add_argument("--base", metavar="DIR", help="SD-Turbo: unet/, vae/ (weights.base)")
    parser.add_argument("--clip", metavar="DIR", help="CLIP ViT-B/32 (weights.clip)")
    parser.add_argument("--vgg", metavar="FILE", help="VGG16 of torchvision (weights.vgg)")
    parser.add_argument("--lpips", metavar="FILE", help="LPIPS' heads for VGG (weights.lpips)")
    parser.add_argument(
        "--marker-vae", type=Path, metavar="RUN", help="start from this trained autoencoder"
    )
    parser.add_argument(
        "--from", dest="start_from", type=Path, metavar="RUN", help="start from this translator"
    )
    add_sensors(parser)
    parser.add_argument(
        "--pairing",
        default="supplement",
        choices=("supplement", "authors_code"),
        help="rule for pairing frames of a press (%(default)s)",
    )
    add_resume(parser)
    parser.add_argument(
        "--full-size-check",
        type=Path,
        metavar="JSON",
        help="moved: python -m benchmarks diffusion-full-size",
    )
    parser.add_argument("--batches", default="4,8,16", metavar="N,...", help="moved with it")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    if options.full_size_check is not None:
        raise LearningError(
            "--full-size-check: moved; run, from the repository: python -m benchmarks "
            f"diffusion-full-size {options.full_size_check}"
        )
    for name in ("archive", "split", "out"):
        if getattr(options, name) is None:
            raise LearningError(f"{name}: missing; allowed: a path")
    if options.marker_vae is not None and options.start_from is not None:
        raise LearningError("--marker-vae, --from: found both; allowed: one, or neither")

    from learning.archive_writer import archive_fingerprint
    from learning.train_command import Training, open_data, run_training, trained_on
    from learning.training.checkpoint import read_model_folder
    from learning.translation.diffusion.data import read_image_pairs
    from learning.translation.diffusion.train import read_pretrained
    from learning.translation.diffusion.train import train as train_translator
    from learning.translation.diffusion.translator import (
        BASE,
        KIND,
        load_vae_adapter,
        require_base,
        vae_adapter_of,
    )
    from learning.translation.diffusion.weights import fingerprint, require_base_folder

    settings = _settings(options)
    archive, split = open_data(options)
    sensors = trained_on(options, archive, split)
    require_base_folder(settings.weights.base)
    base = fingerprint(settings.weights.base)
    vae_adapter, state, begun = None, None, ""
    if options.marker_vae is not None:
        vae_adapter = load_vae_adapter(options.marker_vae, base)
        begun = read_model_folder(options.marker_vae).hash()
    if options.start_from is not None:
        before = read_model_folder(options.start_from, KIND)
        require_base(before, base)
        state, begun = before.weights(), before.hash()
        vae_adapter = vae_adapter_of(state)

    def train(training: Training) -> None:
        pretrained = read_pretrained(settings)
        pairs, validation = (
            read_image_pairs(
                archive,
                split,
                role,
                sensors=sensors,
                preset=options.pairing,
                device=training.device,
                progress=training.reading,
            )
            if len(split.locations(role))
            else None
            for role in ("train", "validation")
        )
        if pairs is None:
            raise LearningError(
                f"{options.split}: found no press to train on; allowed: one or more"
            )
        print(f"{len(pairs):,} pairs of {', '.join(sensors)}", file=sys.stderr)
        with training.stop:
            train_translator(
                pairs,
                pretrained,
                settings,
                validation=validation,
                vae_adapter=vae_adapter,
                start_from=state,
                run=training.run,
                accelerator=training.accelerator,
                stopping=training.stopping,
                progress=training.steps,
            )

    data = [
        "archive",
        archive_fingerprint(archive),
        split.fingerprint,
        *sensors,
        options.pairing,
        base,
        begun,
    ]
    return run_training(options, KIND, settings, " ".join(data), train, facts={BASE: base})


def _settings(options: argparse.Namespace) -> TranslatorSettings:
    """Return the preset's settings, updated from the command line."""
    import json

    from learning.config import read_settings
    from learning.translation.diffusion.settings import TRANSLATOR_PRESETS, TranslatorSettings

    given = [
        f"weights.{name}={json.dumps(getattr(options, name))}"
        for name in ("base", "clip", "vgg", "lpips")
        if getattr(options, name) is not None
    ]
    return read_settings(
        TranslatorSettings, TRANSLATOR_PRESETS, options.preset, [*options.set, *given]
    )
