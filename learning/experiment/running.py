"""Runs an experiment: split, translators, force models, compensation, predictions, scores, report.

Whatever is there already is not made again: an experiment that was stopped goes on where it was.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from learning.compensation import read_stored
from learning.data.fingerprint import archive_fingerprint
from learning.data.splits import Split, make_split, read_split
from learning.errors import LearningError
from learning.evaluation.features import MarkerGrid
from learning.evaluation.force_table import UNSEEN, ForceRow
from learning.evaluation.report import Report, write_report
from learning.evaluation.scoring import score_translation
from learning.evaluation.translation_scores import TranslationScores, read_scores
from learning.experiment.forces import BEFORE, COMPENSATED, TRANSFERRED, Forces
from learning.experiment.models import Places, make_translators, run_command
from learning.experiment.parts import TESTED, Pair, pairs_of, thinned
from learning.experiment.settings import ExperimentSettings
from learning.progress import Progress
from learning.settings import settings_to_dict
from learning.translation import archive as translated
from recorder import MarkerArchive
from recorder.durable import replace_file

Say = Callable[[str], None]


def run_experiment(
    archive_path: Path,
    out: Path,
    settings: ExperimentSettings,
    *,
    pairs: Sequence[str] | None = None,
    device: str = "cpu",
    processes: int = 1,
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
    split = _split(places, settings, archive)
    models = make_translators(places, settings, torch.device(device), say)
    if settings.compensation and not places.compensation.exists():
        asked = ",".join(f"{pair.source}:{pair.target}" for pair in wanted)
        command = ["compensate", str(archive_path), "--out", str(places.compensation)]
        run_command([*command, "--pairs", asked, "--split", str(places.split)], say)
    compensation = read_stored(places.compensation) if settings.compensation else None
    forces = Forces(
        archive, split, settings, places, models, compensation, torch.device(device), processes, say
    )
    predictions = forces.predict_all(wanted)
    scores = _scores(archive, split, settings, places, wanted, models, say)
    return write_report(predictions, scores, places.report, title=settings.description)


def gained(rows: Sequence[ForceRow]) -> str:
    """Return R2 on unseen indenters before and after, means over pairs, axes and translators.

    After is what needs no label of the target: with the default compensation, where there is one.

    Args:
        rows: Errors of an experiment's pairs.
    """
    unseen = [row for row in rows if row.role == UNSEEN]
    after = COMPENSATED if any(row.method == COMPENSATED for row in unseen) else TRANSFERRED
    said = []
    for name, method in ((BEFORE, BEFORE), (TRANSFERRED, after)):
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


def _split(places: Places, settings: ExperimentSettings, archive: MarkerArchive) -> Split:
    if places.split.exists():
        split = read_split(places.split)
        split.check(archive)
        return split
    split = make_split(
        archive,
        validation=settings.validation,
        new_press=settings.new_press,
        seed=settings.seed,
    )
    split.write(places.split)
    return split


def _scores(
    archive: MarkerArchive,
    split: Split,
    settings: ExperimentSettings,
    places: Places,
    pairs: Sequence[Pair],
    models: dict[str, translated.Model],
    say: Say,
) -> list[TranslationScores]:
    """Translate some tested presses into an archive, and score its sensors."""
    if not settings.scored_presses:
        return []
    few = thinned(split, settings.scored_presses, settings.seed)
    roles = [role for role in TESTED if len(few.locations(role))]
    scores = []
    for name, model in models.items():
        path = places.translated(name)
        progress = Progress(f"frames by {name}", sys.stderr)
        try:
            translated.translate_archive(
                archive,
                path,
                [translated.Pair(pair.source, pair.target) for pair in pairs],
                model,
                split=few,
                roles=roles,
                progress=progress,
            )
        finally:
            progress.close()
        for sensor in MarkerArchive(path).values():
            file = places.predictions / f"{sensor.name}.{name}.scores.npz"
            if not file.exists():
                score_translation(
                    archive, sensor, few, roles, MarkerGrid(), seed=settings.seed
                ).write(file)
            scores.append(read_scores(file))
        say(f"translations by {name} scored: {path}")
    return scores
