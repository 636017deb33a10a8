"""`tactile export-onnx`: write one step of a force model as an ONNX file."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Writes a model from frame, state and contact-free image to force [N] and next "
        "state, and compares it with torch. `tactile live` runs it."
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="the folder of a force model")
    parser.add_argument("--out", type=Path, metavar="FILE", help="(MODEL/model.onnx)")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.force import load_force_model
    from learning.force.export import export_onnx

    out = options.out or options.model / "model.onnx"
    difference = export_onnx(load_force_model(options.model), out)
    size = out.stat().st_size / 1e6
    print(f"{out}: {size:.1f} MB, differs from torch by {difference:.1e} of the box of forces")
    return 0
