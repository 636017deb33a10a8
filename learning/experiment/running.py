"""Run of an experiment: split, translators, force models, compensation, predictions, report.

Existing results are reused: an interrupted experiment continues where it stopped.
"""

from collections.abc import Callable, Sequence

import numpy as np

from learning.config import require_same, settings_to_dict
from learning.data.splits import make_split, read_split
from learning.errors import LearningError
from learning.evaluation.predictions import UNSEEN, ForceRow, after
from learning.evaluation.report import Report, write_report
from learning.experiment.frames import labelled_sensors, pairs_of
from learning.experiment.settings import ExperimentSettings
from learning.experiment.stages import (
    BEFORE,
    TRANSFERRED,
    Experiment,
    Places,
    check_settings,
)
from recorder.archive import MarkerArchive, archive_fingerprint

Say = Callable[[str], None]


def run_experiment(
    places: Places,
    settings: ExperimentSettings,
    *,
    pairs: Sequence[str] | None = None,
    device: str = "cpu",
    processes: int = 1,
    say: Say = print,
    where: str = "settings",
) -> Report:
    """Run or continue an experiment and return its report.

    Its archive has frames of all sensors, labels and force-depth presses. `pairs` are
    `SOURCE:TARGET`, by default all directed ones; `processes` track markers. `say` is called with a
    line for each completed part; `where` is the place of the settings in errors.
    """
    archive = MarkerArchive(places.archive)
    if archive.warning:
        raise LearningError(archive.warning)
    experiment = Experiment(places, settings, pairs_of(archive, pairs), device, processes, say=say)
    try:
        check_settings(settings, device)
    except LearningError as error:
        raise LearningError(f"{where}.{error}") from None
    _begin(experiment, archive)
    labelled = labelled_sensors(archive, experiment.split)
    unlabelled = dict.fromkeys(p.target for p in experiment.pairs if p.target not in labelled)
    experiment.unlabelled = frozenset(unlabelled)
    for name in unlabelled:
        say(
            f"{name}: no labels in training presses, so no model is trained on its own labels "
            "(target) and none compensates by them (oracle)"
        )
    return write_report(*experiment.run(), places.report, title=settings.description)


def gained(rows: Sequence[ForceRow]) -> str:
    """Return R2 on unseen indenters before and after, means over pairs, axes and translators.

    "After" is the last method that needs no label of the target.
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


def _begin(experiment: Experiment, archive: MarkerArchive) -> None:
    """Write definition and split of the experiment, or check that existing ones are the same."""
    paths, settings = experiment.places, experiment.settings
    content = {
        "archive": archive_fingerprint(archive),
        "pairs": [f"{pair.source}:{pair.target}" for pair in experiment.pairs],
        **settings_to_dict(settings),
    }
    paths.predictions.mkdir(parents=True, exist_ok=True)
    require_same(paths.out / "experiment.json", content)
    if paths.split.exists():
        read_split(paths.split).check(archive)
        return
    make_split(
        archive, validation=settings.validation, new_press=settings.new_press, seed=settings.seed
    ).write(paths.split)
