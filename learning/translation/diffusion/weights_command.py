"""`tactile import-weights`: convert the authors' checkpoints to run folders."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Reads model_N.pkl of the authors' translator or checkpoint.pth of their "
        "marker autoencoder, without running any code in it, and writes a run folder: for "
        "translate --model, train diffusion --from, or train diffusion --marker-vae."
    )
    parser.add_argument("checkpoint", type=Path, metavar="FILE", help="their .pkl or .pth file")
    parser.add_argument(
        "--base", required=True, metavar="DIR", help="SD-Turbo in diffusers' layout: unet/, vae/"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder to write")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.translation.diffusion.authors import import_checkpoint

    kind, count = import_checkpoint(options.checkpoint, options.base, options.out)
    print(f"{options.out}: {kind}, {count:,} numbers")
    return 0
