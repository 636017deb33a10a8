"""`python -m learning export-onnx`: write one step of a force model as an ONNX file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from learning.command import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the command and its options."""
    parser = subcommands.add_parser(
        "export-onnx",
        description="Writes a model from frame, state and contact-free image to force [N] and next "
        "state, and compares it with torch. `rig live` and `benchmarks latency` run it.",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="the folder of a force model")
    parser.add_argument("--out", type=Path, metavar="FILE", help="(MODEL/model.onnx)")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.force import load_force_model
    from learning.force.export import export_onnx

    out = options.out or options.model / "model.onnx"
    difference = export_onnx(load_force_model(options.model), out)
    size = out.stat().st_size / 1e6
    print(f"{out}: {size:.1f} MB, differs from torch by {difference:.1e} of the box of forces")
    return 0
