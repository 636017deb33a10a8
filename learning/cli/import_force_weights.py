"""`tactile import-force-weights`: convert one of the authors' force models to a run folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from recorder.command_line.options import positive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Reads epoch_N.pth of the authors' force model, without running any code in it, and writes "
        "a run folder for predict, export-onnx, live, or transfer --source-model."
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="their .pth file")
    parser.add_argument(
        "--marker-value",
        type=positive,
        default=1.0,
        metavar="VALUE",
        help="value of a marker in its training images: 1 for heterogeneous sensors, 0.00392157 "
        "for homogeneous and material ones, whose images their code scales by 1/255 (1)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder to write")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.force.authors import import_force_weights

    model = import_force_weights(options.file, options.out, marker_value=options.marker_value)
    count = sum(weight.numel() for weight in model.parameters())
    print(f"{options.out}: force model, {count:,} weights, Fz from -20 to 5 N")
    return 0
