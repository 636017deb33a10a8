"""`tactile markers`: convert sessions to a marker archive."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import add_unseen
from learning.errors import LearningError
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.markers import EfficientSam


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Finds the markers in pictures or taxels of sessions, one session for each "
        "indenter on each sensor. Repeat the command with the same sessions to continue."
    )
    parser.add_argument(
        "sessions",
        nargs="+",
        type=Path,
        metavar="SESSION",
        help="NAME.zarr, or a folder of pictures, each a contact of its own",
    )
    parser.add_argument(
        "--no-contact",
        metavar="PICTURE",
        help="name of the picture without contact in a folder of pictures (ref.png or the like)",
    )
    parser.add_argument("--out", type=Path, metavar="PATH", help="archive to write, X.markers.zarr")
    parser.add_argument(
        "--preset", metavar="NAME", help="preset of marker detection: a name or a YAML file"
    )
    parser.add_argument("--sensor", metavar="NAME", help="name of the sensor in the archive")
    parser.add_argument("--mm-per-px", type=float, help="size of a pixel [mm] (the preset's)")
    parser.add_argument("--sheet", type=Path, metavar="PNG", help="draw a contact sheet as well")
    parser.add_argument(
        "--rate", action="store_true", help="only print the frames per second of one core"
    )
    parser.add_argument(
        "--irregular",
        action="store_true",
        help="the markers have no regular pattern; without it such references are rejected as "
        "shading",
    )
    parser.add_argument("--sam-encoder", type=Path, metavar="ONNX", help="EfficientSAM encoder")
    parser.add_argument("--sam-decoder", type=Path, metavar="ONNX", help="and its decoder")
    add_unseen(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.markers import archive_sessions
    from learning.markers.build import draw_sheet, rates
    from learning.markers.recording import read_group

    sessions = _sessions(options)
    sam = _sam(options)
    if options.rate:
        for line in rates(sessions, preset_name=options.preset, sensor=options.sensor, sam=sam):
            print(line)
        return 0
    if options.out is None:
        raise LearningError("--out: missing; allowed: where the archive goes, or --rate")
    with ItemProgress("frames", sys.stderr) as progress:
        built = archive_sessions(
            sessions,
            options.out,
            preset_name=options.preset,
            sensor=options.sensor,
            mm_per_px=options.mm_per_px,
            unseen=options.unseen,
            sam=sam,
            irregular=options.irregular,
            progress=progress,
        )
    for line in built.lines:
        print(line)
    if options.sheet is not None:
        draw_sheet(options.out, read_group(sessions, options.sensor), options.sheet)
        print(f"{options.sheet}: written")
    print(f"{options.out}: {built.made:,} frames made")
    return 0


def _sessions(options: argparse.Namespace) -> list[Path]:
    """Return the sessions; a folder of pictures becomes one, beside the archive."""
    from learning.markers.fit import ENDINGS
    from recorder.convert import Answers, draft_recordings, write_sessions

    found: list[Path] = []
    for path in options.sessions:
        if path.is_file():
            raise LearningError(
                f"{path}: is no session; allowed: what `tactile import {path} --out NAME.zarr` "
                "makes of it"
            )
        if not path.is_dir() or not any(one.suffix.lower() in ENDINGS for one in path.iterdir()):
            found.append(path)
            continue
        if options.out is None:
            raise LearningError(f"--out: missing; allowed: where the archive of {path} goes")
        session = options.out.with_name(f"{options.out.name.split('.')[0]}.{path.name}.zarr")
        found.append(session)
        if session.exists():
            print(f"{session}: exists already, used for {path}", file=sys.stderr)
            continue
        answers = Answers(
            sensor=options.sensor or path.resolve().parent.name,
            indenter=path.resolve().name,
            stills=True,
            no_contact=() if options.no_contact is None else (options.no_contact,),
        )
        drafts = draft_recordings([path], [], answers)
        with ItemProgress("pictures", sys.stderr) as progress:
            write_sessions(drafts, session, answers, progress)
        print(f"{session}: session of the pictures in {path}", file=sys.stderr)
    return found


def _sam(options: argparse.Namespace) -> EfficientSam | None:
    from learning.markers import EfficientSam

    halves = options.sam_encoder, options.sam_decoder
    if halves == (None, None):
        return None
    if None in halves:
        raise LearningError("--sam-encoder, --sam-decoder: found one; allowed: both or neither")
    return EfficientSam(*halves)
