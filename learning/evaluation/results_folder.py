"""All results of a folder, told apart by what they are."""

from __future__ import annotations

from pathlib import Path

from learning.evaluation import predictions, translation_scores
from learning.evaluation.predictions import Predictions
from learning.evaluation.results_file import read_results
from learning.evaluation.translation_scores import TranslationScores

RESULTS = "*.npz"


def read_folder(folder: Path) -> tuple[list[Predictions], list[TranslationScores]]:
    """Return the predictions and the scores of translations in a folder and those below it.

    Raises:
        LearningError: A damaged file.
    """
    found: tuple[list[Predictions], list[TranslationScores]] = [], []
    for path in sorted(folder.rglob(RESULTS)):
        results = read_results(path)
        if results.kind == predictions.KIND:
            found[0].append(predictions.predictions_in(results, path))
        else:
            found[1].append(translation_scores.scores_in(results, path))
    return found
