"""`tactile train diffusion`: train the paper's translator on a marker archive."""

import argparse
from pathlib import Path

from learning.command import add_inputs, add_sensors, add_settings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains one translator for all pairs of an archive's sensors, from published "
        "weights that you supply: SD-Turbo, CLIP ViT-B/32, VGG16, LPIPS. First it trains the "
        "marker VAE (settings marker_vae.*), in RUN/marker-vae. After Ctrl-C, the same command "
        "continues. Several GPUs: torchrun --nproc-per-node N -m tactile ..."
    )
    add_inputs(parser)
    add_settings(
        parser,
        known="paper_main, paper_supplement, authors_code, ours, or a YAML file (%(default)s)",
    )
    add = parser.add_argument
    add("--base", metavar="DIR", help="SD-Turbo: unet/, vae/ (weights.base)")
    add("--clip", metavar="DIR", help="CLIP ViT-B/32 (weights.clip)")
    add("--vgg", metavar="FILE", help="VGG16 of torchvision (weights.vgg)")
    add("--lpips", metavar="FILE", help="LPIPS' heads for VGG (weights.lpips)")
    about = "start from this marker VAE, such as marker-vae/ in the folder of another training"
    add("--marker-vae", type=Path, metavar="RUN", help=about)
    add("--from", dest="start_from", type=Path, metavar="RUN", help="start from this translator")
    add_sensors(parser)
    about = "rule for pairing frames of a press (%(default)s)"
    add("--pairing", default="supplement", choices=("supplement", "authors_code"), help=about)


def run(options: argparse.Namespace) -> int:
    """Train, and return the exit code."""
    from learning.translation.diffusion.train import run as train

    return train(options)
