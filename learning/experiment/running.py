"""Runs an experiment: split, translators, force models, compensation, predictions, scores, report.

Whatever is there already is not made again: an experiment that was stopped goes on where it was.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from learning.archive_writer import archive_fingerprint
from learning.config import settings_to_dict
from learning.data.splits import make_split, read_split
from learning.errors import LearningError
from learning.evaluation.predictions import UNSEEN, ForceRow, after
from learning.evaluation.report import Report, write_report
from learning.experiment.forces import BEFORE, TRANSFERRED
from learning.experiment.models import Places
from learning.experiment.parts import Pair, pairs_of
from learning.experiment.settings import ExperimentSettings
from learning.experiment.worker import Work, do_all
from recorder import MarkerArchive
from recorder.store import replace_file

Say = Callable[[str], None]


def run_experiment(
    archive_path: Path,
    out: Path,
    settings: ExperimentSettings,
    *,
    pairs: Sequence[str] | None = None,
    device: str = "cpu",
    processes: int = 1,
    jobs: int = 1,
    say: Say = print,
) -> Report:
    """Run an experiment, or go on with it; return its report.

    Args:
        archive_path: Frames of all sensors, with labels and force-depth presses.
        out: Folder of everything that is made.
        settings: Which models, on how much data.
        pairs: `SOURCE:TARGET`; None: all directed pairs.
        device: Where models are trained and frames are translated.
        processes: How many follow markers.
        jobs: Models trained side by side, each in a process of its own.
        say: Called with a line for each thing that was done.

    Raises:
        LearningError: The folder is that of another experiment, or data that cannot be used.
        SessionError: A damaged archive.
        KeyboardInterrupt: It was stopped; the same call goes on.
    """
    archive, places = MarkerArchive(archive_path), Places(out, archive_path)
    if archive.warning:
        raise LearningError(archive.warning)
    wanted = pairs_of(archive, pairs)
    _begin(places, settings, archive, wanted)
    _write_split(places, settings, archive)
    work = Work(archive_path, out, settings, wanted, device, max(1, processes // jobs))
    done = do_all(work, jobs, say)
    return write_report(
        [found for each in done for found in each.predictions],
        [scores for each in done for scores in each.scores],
        places.report,
        title=settings.description,
    )


def gained(rows: Sequence[ForceRow]) -> str:
    """Return R2 on unseen indenters before and after, means over pairs, axes and translators.

    After is the last method that needs no label of the target.

    Args:
        rows: Errors of an experiment's pairs.
    """
    unseen = [row for row in rows if row.role == UNSEEN]
    said = []
    for name, method in ((BEFORE, BEFORE), (TRANSFERRED, after({row.method for row in unseen}))):
        values = [row.errors.r2_mean for row in unseen if row.method == method]
        said.append(f"{name} R2 {np.mean(values):.3f}" if values else f"{name} R2 unknown")
    return "  ".join(said)


def _begin(
    places: Places, settings: ExperimentSettings, archive: MarkerArchive, pairs: Sequence[Pair]
) -> None:
    """Write what the experiment is, or make sure that the one that is there is the same."""
    content = {
        "archive": archive_fingerprint(archive),
        "pairs": [f"{pair.source}:{pair.target}" for pair in pairs],
        **settings_to_dict(settings),
    }
    # As JSON has it, where tuples are lists.
    plain: dict[str, Any] = json.loads(json.dumps(content))
    path = places.out / "experiment.json"
    if not path.exists():
        places.predictions.mkdir(parents=True, exist_ok=True)
        replace_file(path, (json.dumps(plain, indent=1) + "\n").encode())
        return
    found = json.loads(path.read_text(encoding="utf-8"))
    for key in plain:
        if found.get(key) != plain[key]:
            raise LearningError(
                f"{path}.{key}: found {found.get(key)!r}, asked for {plain[key]!r}; allowed: the "
                "same experiment, or another folder"
            )


def _write_split(places: Places, settings: ExperimentSettings, archive: MarkerArchive) -> None:
    """Write the roles of presses, or make sure that those that are there fit the archive."""
    if places.split.exists():
        read_split(places.split).check(archive)
        return
    made = make_split(
        archive,
        validation=settings.validation,
        new_press=settings.new_press,
        seed=settings.seed,
    )
    made.write(places.split)
