"""`tactile evaluate`: report on predictions and translations."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from learning.errors import LearningError
from recorder.command_line.options import add_device, add_seed, names, whole
from recorder.progress import ItemProgress

ROLES = "new_indenter"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Collects results of `predict`, and scores of translated frames, in one HTML "
        "page with CSV tables. With --archive and --translated, translated frames are scored first "
        "(Dice, SSIM, markers [px, mm], distances) and the scores are kept in FOLDER."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of .npz results")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="report folder")
    parser.add_argument("--title", default="What was gained", help="title of the page")
    scoring = parser.add_argument_group("scoring translated frames")
    scoring.add_argument("--archive", type=Path, metavar="ARCHIVE", help="with the real frames")
    scoring.add_argument(
        "--translated",
        type=Path,
        action="append",
        default=[],
        metavar="ARCHIVE",
        help="translated from it by `translate`; repeatable",
    )
    scoring.add_argument("--split", type=Path, metavar="JSON", help="split.json of a training")
    scoring.add_argument(
        "--role",
        type=names,
        default=ROLES,
        metavar="ROLE,...",
        help=f"which presses are scored ({ROLES})",
    )
    scoring.add_argument(
        "--features",
        default="marker-grid",
        metavar="NAME|PATH",
        help="features for distances: marker-grid, the folder of a marker VAE, or "
        "pt_inception-2015-12-05-6726825d.pth, for FID and KID (marker-grid)",
    )
    scoring.add_argument(
        "--frames", type=whole(), default=1000, help="maximum pairs per role (1000)"
    )
    add_device(scoring, "device of the features")
    add_seed(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.evaluation.report import read_folder, write_report

    if options.translated or options.archive:
        _score(options)
    if not options.folder.is_dir():
        raise LearningError(f"{options.folder}: is no folder; allowed: one of what `predict` wrote")
    predictions, scores = read_folder(options.folder)
    with ItemProgress("parts", sys.stderr) as progress:
        report = write_report(
            predictions,
            scores,
            options.out,
            title=options.title,
            seed=options.seed,
            progress=progress,
        )
    for line in report.lines:
        print(line)
    print(f"{report.files[0]}: written, beside {len(report.files) - 1} tables")
    return 0


def _score(options: argparse.Namespace) -> None:
    from learning.data.splits import read_split
    from learning.evaluation.distribution import load_extractor
    from learning.evaluation.translation import score_translation
    from recorder import MarkerArchive

    for name in ("archive", "translated", "split"):
        if not getattr(options, name):
            raise LearningError(
                f"--{name}: missing; allowed: --archive, --translated and --split together"
            )
    archive, split = MarkerArchive(options.archive), read_split(options.split)
    extractor = load_extractor(options.features, options.device)
    for path in options.translated:
        for name, sensor in MarkerArchive(path).items():
            print(f"scoring {name} of {path.name}", file=sys.stderr)
            with ItemProgress("frames", sys.stderr) as progress:
                scores = score_translation(
                    archive,
                    sensor,
                    split,
                    options.role,
                    extractor,
                    frames=options.frames,
                    seed=options.seed,
                    progress=progress,
                )
            features = extractor.name.split(":")[-1].split(",")[0]
            scores.write(options.folder / f"{name}.{scores.translator}.{features}.npz")
