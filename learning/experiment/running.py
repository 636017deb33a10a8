"""Run of an experiment: split, translators, force models, compensation, predictions, report.

Existing results are reused: an interrupted experiment continues where it stopped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from learning.archive_writer import archive_fingerprint
from learning.config import settings_to_dict
from learning.data.splits import make_split, read_split
from learning.errors import LearningError
from learning.evaluation.predictions import UNSEEN, ForceRow, after
from learning.evaluation.report import Report, write_report
from learning.experiment.forces import BEFORE, TRANSFERRED, force_settings
from learning.experiment.models import Places, check_translators
from learning.experiment.parts import Pair, labelled_sensors, pairs_of
from learning.experiment.settings import ExperimentSettings
from learning.experiment.worker import Job, do_all
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
    where: str = "settings",
) -> Report:
    """Run or continue an experiment and return its report.

    Args:
        archive_path: Frames of all sensors, with labels and force-depth presses.
        out: Folder of all results.
        settings: Settings of models and amount of data.
        pairs: `SOURCE:TARGET`; None: all directed pairs.
        device: Device of training and translation.
        processes: Number of processes that track markers.
        jobs: Number of models trained in parallel, each in its own process.
        say: Called with a line for each completed part.
        where: Place of the settings in errors, such as their file.
    """
    if jobs < 1:
        raise LearningError(f"--jobs: found {jobs}; allowed: 1 or more")
    archive, places = MarkerArchive(archive_path), Places(out, archive_path)
    if archive.warning:
        raise LearningError(archive.warning)
    wanted = pairs_of(archive, pairs)
    try:
        # These presets are used only hours later, but a mistake in them is refused now.
        check_translators(settings)
        for tuning in (False, True):
            force_settings(settings, archive, torch.device(device), tuning=tuning)
    except LearningError as error:
        raise LearningError(f"{where}.{error}") from None
    _begin(places, settings, archive, wanted)
    _write_split(places, settings, archive)
    labelled = labelled_sensors(archive, read_split(places.split))
    unlabelled = dict.fromkeys(pair.target for pair in wanted if pair.target not in labelled)
    for name in unlabelled:
        say(
            f"{name}: no labels in training presses, so no model is trained on its own labels "
            "(target) and none compensates by them (oracle)"
        )
    work = Job(
        archive_path,
        out,
        settings,
        wanted,
        device,
        max(1, processes // jobs),
        unlabelled=frozenset(unlabelled),
    )
    done = do_all(work, jobs, say)
    return write_report(
        [found for each in done for found in each.predictions],
        [scores for each in done for scores in each.scores],
        places.report,
        title=settings.description,
    )


def gained(rows: Sequence[ForceRow]) -> str:
    """Return R2 on unseen indenters before and after, means over pairs, axes and translators.

    "After" is the last method that needs no label of the target.

    Args:
        rows: Errors of an experiment's pairs.
    """
    if not rows:
        return "no labels to compare with"
    unseen = [row for row in rows if row.role == UNSEEN]
    reported = []
    for name, method in ((BEFORE, BEFORE), (TRANSFERRED, after({row.method for row in unseen}))):
        some = [row.errors for row in unseen if row.method == method]
        mean = f"{np.mean([one.r2_mean for one in some]):.3f}" if some else "unknown"
        reported.append(f"{name} R2 {mean}{''.join(dict.fromkeys(one.of_axes for one in some))}")
    return "  ".join(reported)


def _begin(
    places: Places, settings: ExperimentSettings, archive: MarkerArchive, pairs: Sequence[Pair]
) -> None:
    """Write the definition of the experiment, or check that an existing one is the same."""
    content = {
        "archive": archive_fingerprint(archive),
        "pairs": [f"{pair.source}:{pair.target}" for pair in pairs],
        **settings_to_dict(settings),
    }
    # Convert by JSON, in which tuples become lists.
    plain: dict[str, Any] = json.loads(json.dumps(content))
    path = places.out / "experiment.json"
    if not path.exists():
        places.predictions.mkdir(parents=True, exist_ok=True)
        replace_file(path, (json.dumps(plain, indent=1) + "\n").encode())
        return
    stored = json.loads(path.read_text(encoding="utf-8"))
    for key in plain:
        if stored.get(key) != plain[key]:
            raise LearningError(
                f"{path}.{key}: found {stored.get(key)!r}, asked for {plain[key]!r}; allowed: the "
                "same experiment, or another folder"
            )


def _write_split(places: Places, settings: ExperimentSettings, archive: MarkerArchive) -> None:
    """Write the split, or check that an existing one fits the archive."""
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
