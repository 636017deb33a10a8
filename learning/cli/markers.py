"""`tactile markers`: convert sessions to a marker archive."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import add_unseen
from learning.errors import LearningError
from recorder.command_line.options import next_command
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.markers.efficient_sam import EfficientSam


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Finds the markers in pictures or taxels of sessions, one session for each "
        "indenter on each sensor. Repeat the command with the same sessions to continue."
    )
    add = parser.add_argument
    add("sessions", nargs="+", type=Path, metavar="SESSION", help="NAME.zarr")
    add("--out", type=Path, required=True, metavar="PATH", help="archive to write, X.markers.zarr")
    add("--preset", metavar="NAME", help="preset of marker detection: a name or a YAML file")
    add("--sensor", metavar="NAME", help="name of the sensor in the archive")
    add("--finger", choices=("left", "right"), help="finger to read, of sessions of a hand")
    add("--mm-per-px", type=float, help="size of a pixel [mm] (the preset's)")
    add("--sheet", type=Path, metavar="PNG", help="draw a contact sheet as well")
    add(
        "--irregular",
        action="store_true",
        help="the markers have no regular pattern; without it such references are rejected as "
        "shading",
    )
    add("--sam-encoder", type=Path, metavar="ONNX", help="EfficientSAM encoder")
    add("--sam-decoder", type=Path, metavar="ONNX", help="and its decoder")
    add_unseen(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.markers.build import archive_sessions

    _require_sessions(options.sessions)
    sam = _sam(options)
    with ItemProgress("frames", sys.stderr) as progress:
        frames, lines = archive_sessions(
            options.sessions,
            options.out,
            preset_name=options.preset,
            sensor=options.sensor,
            finger=options.finger,
            mm_per_px=options.mm_per_px,
            unseen=options.unseen,
            sam=sam,
            irregular=options.irregular,
            progress=progress,
        )
    for line in lines:
        print(line)
    if options.sheet is not None:
        from learning.markers.recording import read_group
        from learning.markers.sheet import draw_sheet

        recordings, _ = read_group(options.sessions, options.sensor, options.finger)
        draw_sheet(options.out, recordings, options.sheet)
        print(f"{options.sheet}: written")
    print(f"{options.out}: {frames:,} frames made")
    return 0


def _require_sessions(paths: Sequence[Path]) -> None:
    """Reject files and folders of pictures."""
    for path in paths:
        if path.is_file() or (path.is_dir() and not (path / "zarr.json").exists()):
            importing = next_command("import", path, out="NAME.zarr")
            raise LearningError(
                f"{path}: is no session; allowed: what `{importing}` "
                "makes of it (--stills if each picture is a contact of its own)"
            )


def _sam(options: argparse.Namespace) -> EfficientSam | None:
    from learning.markers.efficient_sam import EfficientSam

    halves = options.sam_encoder, options.sam_decoder
    if halves == (None, None):
        return None
    if None in halves:
        raise LearningError("--sam-encoder, --sam-decoder: found one; allowed: both or neither")
    return EfficientSam(*halves)
