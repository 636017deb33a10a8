"""`python -m learning import-weights`: the authors' checkpoints become folders of trainings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from learning.command import Verbs


def add_to(verbs: Verbs) -> None:
    """Add the verb and its options."""
    parser = verbs.add_parser(
        "import-weights",
        description="Reads model_N.pkl of the authors' translator or checkpoint.pth of their "
        "marker autoencoder, without running anything that is in it, and writes the folder of a "
        "training: for translate --model, train-diffusion --from, or train-diffusion --marker-vae.",
    )
    parser.add_argument("checkpoint", type=Path, metavar="FILE", help="a .pkl or .pth of theirs")
    parser.add_argument(
        "--base", required=True, metavar="DIR", help="SD-Turbo in diffusers' layout: unet/, vae/"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder to write")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.translation.diffusion.authors import import_checkpoint

    kind, count = import_checkpoint(options.checkpoint, options.base, options.out)
    print(f"{options.out}: {kind}, {count:,} numbers")
    return 0
