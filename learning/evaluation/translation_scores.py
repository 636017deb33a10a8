"""The scores of translated frames: rows of tables, baselines too, and the file of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.evaluation.results_file import Results, read_results, write_results

KIND = "translation"
TRANSLATED, SOURCE, REFERENCE, NEAREST, FLOOR = (
    "translated",
    "source as is",
    "reference as is",
    "nearest frame",
    "real",
)
METHODS = (TRANSLATED, SOURCE, REFERENCE, NEAREST, FLOOR)
"""What is scored: the translator; the frames it was given; the untouched target; the training frame
of the target whose motion is nearest; and the target's own frames: half of them against the other
half, or against the truth of the simulator."""


@dataclass(frozen=True, slots=True)
class PairedScore:
    """Frames beside the true frames of the same press and phase."""

    role: str
    """Role of the presses in the split."""
    method: str
    """One of `METHODS`."""
    frames: int
    """How many pairs."""
    dice: float
    """Mean Dice of the masks."""
    iou: float
    """Mean intersection over union of the masks."""
    centroid_px: float
    """Median distance of markers that belong together [px]."""
    centroid_p95_px: float
    """Its 95th percentile [px]."""
    centroid_mm: float
    """Its median on the surface [mm]."""
    count_mismatch: float
    """Share of frames with more or fewer markers than the true one."""
    area_ratio_error: float
    """Mean of |marker area / true marker area - 1|."""
    epe_px: float
    """Mean distance of markers from where the true displacement takes them [px]; NaN: not known."""
    epe_mm: float
    """The same on the surface [mm]."""


@dataclass(frozen=True, slots=True)
class DistanceScore:
    """Features of frames beside those of real frames of other presses."""

    role: str
    """Role of the presses in the split."""
    method: str
    """One of `METHODS`."""
    extractor: str
    """What made the features, by the hash of its weights."""
    frechet: float
    """Frechet distance."""
    kernel: float
    """Squared kernel distance, mean of random subsets."""
    kernel_std: float
    """Its standard deviation over the subsets."""
    classifier: float
    """Accuracy of telling the two apart: 0.5 is chance."""
    mixing: float
    """How well nearest neighbours are mixed: 1 fully, 0 not at all."""
    samples: int
    """Images on either side."""
    dimensions: int
    """Width of the features."""
    seed: int
    """Of the halves, subsets and folds."""


@dataclass(frozen=True, slots=True, eq=False)
class TranslationScores:
    """What is known of one translator between two sensors."""

    source: str
    """Whose frames were translated."""
    target: str
    """What they were translated to."""
    translator: str
    """Name of the translator."""
    model: str
    """What names its weights, their hash."""
    paired: tuple[PairedScore, ...]
    """Rows on paired frames."""
    distances: tuple[DistanceScore, ...]
    """Rows on features."""
    features: Mapping[str, NDArray[np.float32]]
    """Some features (n, d) of `SOURCE`, `TRANSLATED` and `FLOOR`, to look at."""

    def write(self, path: Path) -> None:
        """Write them as an .npz.

        Raises:
            OSError: Not writable.
        """
        said = {
            "source": self.source,
            "target": self.target,
            "translator": self.translator,
            "model": self.model,
            "paired": [_said(row) for row in self.paired],
            "distances": [_said(row) for row in self.distances],
        }
        write_results(path, Results(KIND, said, dict(self.features)))


def read_scores(path: Path) -> TranslationScores:
    """Return scores that were written.

    Raises:
        LearningError: Not such a file, or one that does not hold them.
    """
    return scores_in(read_results(path), path)


def scores_in(results: Results, path: Path) -> TranslationScores:
    """Return the scores that a file holds; `path` begins the message of an error.

    Raises:
        LearningError: Results of another kind, or not all of them.
    """
    if results.kind != KIND:
        raise LearningError(f"{path}: found {results.kind}; allowed: {KIND}")
    said = results.said
    try:
        return TranslationScores(
            str(said["source"]),
            str(said["target"]),
            str(said["translator"]),
            str(said["model"]),
            tuple(PairedScore(**_numbers(row, PairedScore)) for row in said["paired"]),
            tuple(DistanceScore(**_numbers(row, DistanceScore)) for row in said["distances"]),
            results.arrays,
        )
    except (KeyError, TypeError) as error:
        raise LearningError(f"{path}: found no translation scores: {error!r}") from None


def paired_rows(
    scores: Iterable[TranslationScores],
) -> tuple[tuple[TranslationScores, PairedScore], ...]:
    """Return the rows on paired frames, once each: features of other extractors change none."""
    found: dict[tuple[str, ...], tuple[TranslationScores, PairedScore]] = {}
    for one in scores:
        for row in one.paired:
            key = one.source, one.target, one.translator, row.role, row.method
            found.setdefault(key, (one, row))
    return tuple(found.values())


def score_line(one: TranslationScores, row: PairedScore | DistanceScore) -> dict[str, Any]:
    """Return a row of scores as a line of a CSV."""
    named = {"source": one.source, "target": one.target, "translator": one.translator}
    return {**named, **asdict(row)}


def require_alone(scores: Sequence[TranslationScores]) -> None:
    """Refuse two scores of the same thing.

    Raises:
        LearningError: The same pair, translator, role, method and extractor twice.
    """
    seen = set()
    for one in scores:
        pair = (one.source, one.target, one.translator)
        keys = [(*pair, row.role, row.method, row.extractor) for row in one.distances]
        for key in keys:
            if key in seen:
                raise LearningError(
                    f"translation scores: found {', '.join(key)} twice; allowed: once"
                )
            seen.add(key)


def _said(row: PairedScore | DistanceScore) -> dict[str, Any]:
    """Return a row as JSON has it, which knows no NaN."""
    return {key: None if value != value else value for key, value in asdict(row).items()}


def _numbers(row: Mapping[str, Any], kind: type[PairedScore | DistanceScore]) -> dict[str, Any]:
    floats = {field.name for field in fields(kind) if field.type == "float"}
    return {
        key: float("nan") if value is None and key in floats else value
        for key, value in row.items()
    }
