"""`python -m learning import-weights`: convert the authors' checkpoints to run folders."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from learning.command import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the verb and its options."""
    parser = subcommands.add_parser(
        "import-weights",
        description="Reads model_N.pkl of the authors' translator or checkpoint.pth of their "
        "marker autoencoder, without running any code in it, and writes a run folder: for "
        "translate --model, train-diffusion --from, or train-diffusion --marker-vae.",
    )
    parser.add_argument("checkpoint", type=Path, metavar="FILE", help="their .pkl or .pth file")
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
