"""Scores a translated archive against the real frames of the target, beside its baselines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.evaluation.baselines import nearest_frames
from learning.evaluation.distances import frechet_distance, kernel_distance
from learning.evaluation.features import Extractor
from learning.evaluation.paired_scoring import paired_score, real_frames
from learning.evaluation.translation_scores import (
    FLOOR,
    NEAREST,
    REFERENCE,
    SOURCE,
    TRANSLATED,
    DistanceScore,
    PairedScore,
    TranslationScores,
)
from learning.evaluation.two_samples import NEIGHBOURS, classifier_accuracy, mixing_score
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor, location_pairs

if TYPE_CHECKING:
    from learning.data.splits import Role, Split

Rows = NDArray[np.int64]
Packed = NDArray[np.uint8]
Floats = NDArray[np.float64]

FRAMES = 1000
"""Pairs of a role that are scored at most, drawn at random."""
SUBSET, SUBSETS = 500, 50
"""Samples in a subset of the kernel distance, and how many subsets."""
SHOWN = 150
"""Features that are kept of each side, to draw them."""
LEAST = 12
"""Locations without which there are no distances: six on each side."""


def score_translation(
    archive: MarkerArchive,
    translated: ArchivedSensor,
    split: Split,
    roles: Sequence[Role],
    extractor: Extractor,
    *,
    frames: int = FRAMES,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> TranslationScores:
    """Return how good translated frames are, beside the baselines and the floor.

    Args:
        archive: That the frames were made from: it has source and target.
        translated: The translated sensor, `A-to-B`.
        split: Says which presses are which.
        roles: Which of them are scored.
        extractor: Makes the features that distances are measured in.
        frames: Location pairs of a role at most.
        seed: Of what is drawn.
        progress: Called with the frames that are scored and those there will be.

    Raises:
        LearningError: Not a translated sensor, one of other sensors, or no pairs of a role.
        SessionError: A damaged archive.
    """
    source, target = (_sensor_of(archive, translated, end) for end in ("source", "target"))
    split.check(archive)
    known = split.rows(target.table, "train")
    drawn = [_pairs(source, target, translated, split, role, frames, seed) for role in roles]
    paired: list[PairedScore] = []
    distances: list[DistanceScore] = []
    kept: dict[str, NDArray[np.float32]] = {}
    total = sum(5 * len(ours.real) for ours in drawn)
    done = 0
    for role, ours in zip(roles, drawn, strict=True):
        real = real_frames(target, ours.real)
        shown = {
            TRANSLATED: translated.packed(ours.translated),
            SOURCE: source.packed(ours.source),
            REFERENCE: target.references[target.table["reference"][real.rows]],
        }
        if len(known):
            shown[NEAREST] = target.packed(nearest_frames(target.table, real.rows, known))
        shown[FLOOR] = real.packed
        features = {}
        for method, packed in shown.items():
            paired.append(paired_score(packed, real, role, method))
            features[method] = _features(extractor, packed)
            done += len(real.rows)
            progress(done, total)
        location = target.table["location"][real.rows]
        halves = half_of_locations(location, seed)
        if len(np.unique(location)) >= LEAST:
            distances += _distances(features, location, halves, role, extractor.name, seed)
        for method in (SOURCE, TRANSLATED, FLOOR):
            there = halves if method == FLOOR else ~halves
            kept.setdefault(method, features[method][there][:SHOWN].astype(np.float32))
    progress(total, total)
    return TranslationScores(
        source.name,
        target.name,
        str(translated.attrs["model"]),
        str(translated.attrs.get("model_sha256", "")),
        tuple(paired),
        tuple(distances),
        kept,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Features of some frames."""

    features: Floats
    """What an extractor makes of them (n, d)."""
    location: NDArray[np.integer[Any]]
    """Where each was pressed (n,)."""


def distance_score(
    real: Sample, found: Sample, role: str, method: str, extractor: str, seed: int
) -> DistanceScore:
    """Return the distances of frames from real ones of other presses.

    Raises:
        LearningError: Too few, or features of other widths.
    """
    one, other = real.features, found.features
    kernel, spread = kernel_distance(one, other, size=SUBSET, subsets=SUBSETS, seed=seed)
    groups = np.concatenate([real.location, found.location])
    return DistanceScore(
        role=role,
        method=method,
        extractor=extractor,
        frechet=frechet_distance(one, other),
        kernel=kernel,
        kernel_std=spread,
        classifier=classifier_accuracy(one, other, groups, seed=seed),
        mixing=mixing_score(one, other, min(NEIGHBOURS, len(one) + len(other) - 1)),
        samples=min(len(one), len(other)),
        dimensions=one.shape[1],
        seed=seed,
    )


def half_of_locations(location: NDArray[np.integer], seed: int) -> NDArray[np.bool_]:
    """Return which frames (n,) are of the half of the locations that real frames are taken from.

    What is judged is taken from the other half, so that it is never the frame's own twin.
    """
    different = np.unique(location)
    chosen = np.random.default_rng(seed).permutation(different)[: len(different) // 2]
    return np.isin(location, chosen)


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Rows that belong together: of the target, of the source, of the translated frames."""

    real: Rows
    source: Rows
    translated: Rows


def _pairs(
    source: ArchivedSensor,
    target: ArchivedSensor,
    translated: ArchivedSensor,
    split: Split,
    role: Role,
    frames: int,
    seed: int,
) -> _Pairs:
    before = location_pairs(source.table, target.table)
    after = location_pairs(translated.table, target.table)
    real, one, other = np.intersect1d(
        before.target, after.target, assume_unique=True, return_indices=True
    )
    of_role = np.flatnonzero(np.isin(real, split.rows(target.table, role)))
    if not len(of_role):
        raise LearningError(
            f"{translated.name}: found no location pairs of role {role} with {target.name}; "
            "allowed: a role that was translated, of presses that both sensors have"
        )
    count = min(frames, len(of_role))
    of_role = np.sort(np.random.default_rng(seed).permutation(of_role)[:count])
    return _Pairs(
        real[of_role],
        before.source[one[of_role]],
        after.source[other[of_role]],
    )


def _sensor_of(archive: MarkerArchive, translated: ArchivedSensor, end: str) -> ArchivedSensor:
    name = translated.attrs.get(end)
    if "model" not in translated.attrs or name not in archive:
        raise LearningError(
            f"{translated.name}: found {end} {name!r}; allowed: frames translated from and to "
            f"sensors of {archive.name}: {', '.join(archive)}"
        )
    return archive[str(name)]


def _features(extractor: Extractor, packed: Packed) -> Floats:
    from learning.data.images import shrink

    return extractor.features(shrink(packed))


def _distances(
    features: dict[str, Floats],
    location: NDArray[np.integer[Any]],
    halves: NDArray[np.bool_],
    role: str,
    extractor: str,
    seed: int,
) -> list[DistanceScore]:
    real = Sample(features[FLOOR][halves], location[halves])
    return [
        distance_score(
            real, Sample(found[~halves], location[~halves]), role, method, extractor, seed
        )
        for method, found in features.items()
    ]
