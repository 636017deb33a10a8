"""Scores of a translated archive against the target's real frames, with baselines."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from skimage import metrics

from learning.data.images import shrink
from learning.data.splits import Role, Split
from learning.errors import LearningError
from learning.evaluation.distribution import (
    NEIGHBOURS,
    Extractor,
    frechet_distance,
    kernel_distance,
    mixing_score,
)
from learning.evaluation.results_file import Results, read_results, write_results
from learning.translation.translator import SensorView
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor, location_pairs
from recorder.markers import SMALLEST_PX, Blobs, Lattice, find_blobs, moved, unpack

# Overlap of masks: Dice, intersection over union, area. Similarity of images.

Floats = NDArray[np.float64]
MaskArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Overlap:
    """Pixel counts of pairs of masks."""

    common: NDArray[np.int64]
    """Pixels set in both (n,)."""
    evaluated: NDArray[np.int64]
    """Pixels set in the evaluated mask (n,)."""
    true: NDArray[np.int64]
    """Pixels set in the true mask (n,)."""

    @property
    def dice(self) -> Floats:
        """Twice the common pixels over the sum of both (n,); 1 if both are empty."""
        return _share(2 * self.common, self.evaluated + self.true)

    @property
    def iou(self) -> Floats:
        """Common pixels over those that are set in either (n,); 1 if both are empty."""
        return _share(self.common, self.evaluated + self.true - self.common)

    @property
    def area_ratio_error(self) -> Floats:
        """|evaluated / true - 1| (n,); NaN if the true mask is empty."""
        empty = self.true == 0
        ratio = self.evaluated / np.where(empty, 1, self.true)
        return np.where(empty, np.nan, np.abs(ratio - 1))


def overlap(evaluated: MaskArray, true: MaskArray) -> Overlap:
    """Count the pixels that masks (n, h, w) have in common."""
    pixels = (each.sum(axis=(1, 2), dtype=np.int64) for each in (evaluated & true, evaluated, true))
    return Overlap(*pixels)


def _share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> Floats:
    return np.where(whole == 0, 1.0, part / np.where(whole == 0, 1, whole))


def structural_similarity(evaluated: NDArray[np.uint8], true: NDArray[np.uint8]) -> Floats:
    """Return SSIM (n,) of images (n, h, w), Wang et al. (2004), with Gaussian windows of 1.5 px."""
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    pairs = zip(evaluated, true, strict=True)
    return np.array([metrics.structural_similarity(*pair, **window) for pair in pairs])


# Errors of marker positions and counts.
#
# Markers of two images match if each is the other's nearest. Where the position error exceeds half
# the distance of neighbours, a wrong marker may be nearer: such errors are underestimated, and are
# also visible in the overlap of the masks.


def marker_errors(
    evaluated: MaskArray, true: MaskArray, smallest_px: int = SMALLEST_PX
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the errors of the markers of frames (n, h, w) with respect to the true frames.

    These are the offset from each true marker to its match, column and row (m, 2) [px], of all
    frames, and True for frames with a wrong number of markers (n,). Patches of fewer pixels than
    `smallest_px` are ignored.
    """
    ours, here = _centres(find_blobs(evaluated, smallest_px), len(evaluated))
    theirs, there = _centres(find_blobs(true, smallest_px), len(true))
    apart = [_apart(one, other) for one, other in zip(here, there, strict=True)]
    return np.concatenate([np.empty((0, 2)), *apart]), ours != theirs


def endpoint_errors(
    evaluated: MaskArray,
    reference: NDArray[np.bool_],
    displacement: NDArray[np.floating],
    lattice: Lattice,
    smallest_px: int = SMALLEST_PX,
) -> Floats:
    """Return the offsets of markers of frames from their true displaced positions (m, 2) [px].

    This is the end-point error of optical flow, at the markers: a marker at p in the image without
    contact belongs at p + d(p). A curved marker's centre deviates slightly from that; the error of
    true frames shows by how much. Frames are (n, 480, 640), their true displacement (n, rows,
    columns, 2) [px] on the lattice; patches of fewer than `smallest_px` pixels are ignored.
    """
    rest, blobs = find_blobs(reference[None], smallest_px), find_blobs(evaluated, smallest_px)
    _, centres = _centres(blobs.only(blobs.whole), len(evaluated))
    apart = [np.empty((0, 2))]
    for here, field in zip(centres, displacement, strict=True):
        there = moved(rest.centre[rest.whole], field, lattice)
        apart.append(_apart(here, there[np.isfinite(there).all(axis=1)]))
    return np.concatenate(apart)


def _centres(blobs: Blobs, frames: int) -> tuple[NDArray[np.int64], list[Floats]]:
    """Return the number of markers of each frame (n,), and their centres frame by frame."""
    counts = np.bincount(blobs.frame, minlength=frames)
    return counts, np.split(blobs.centre, np.cumsum(counts)[:-1])


def _apart(evaluated: Floats, true: Floats) -> Floats:
    """Return evaluated - true (m, 2) [px] of mutual nearest neighbours."""
    if not len(evaluated) or not len(true):
        return np.empty((0, 2))
    apart = np.linalg.norm(evaluated[:, None] - true[None], axis=-1)
    nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
    both = back[nearest] == np.arange(len(evaluated))
    return np.asarray(evaluated[both] - true[nearest[both]], np.float64)


# Baselines of translators: frames that are available without translation.

Rows = NDArray[np.int64]
Table = Mapping[str, NDArray[Any]]

_BASELINES_AT_ONCE = 2**22  # distances computed at once


def nearest_frames(table: Table, wanted: Rows, candidates: Rows) -> Rows:
    """Return, for each wanted row (n,), the known row (m,) with the nearest motion (n,).

    Nearest is by Euclidean distance of commanded depth and position, among frames of the same
    phase, or of all phases if that phase is unknown. The indenter is ignored: the wanted one may be
    unseen.
    """
    if not len(candidates):
        raise LearningError("nearest frame: found no frames to choose from; allowed: one or more")
    nearest = np.empty(len(wanted), np.int64)
    phase = table["phase"][wanted]
    for code in np.unique(phase).tolist():
        here = np.flatnonzero(phase == code)
        among = candidates[table["phase"][candidates] == code]
        among = among if len(among) else candidates
        step = max(_BASELINES_AT_ONCE // len(among), 1)
        for first in range(0, len(here), step):
            some = here[first : first + step]
            apart = cdist(_motion(table, wanted[some]), _motion(table, among), "sqeuclidean")
            nearest[some] = among[apart.argmin(axis=1)]
    return nearest


def _motion(table: Table, rows: Rows) -> NDArray[np.float64]:
    """Return position and depth (n, 3) [m]."""
    return np.column_stack([table["position"][rows], table["depth"][rows]])


# Scores of translated frames and baselines: rows of tables, and their file.

KIND = "translation"
TRANSLATED, SOURCE, REFERENCE = "translated", "source as is", "reference as is"
NEAREST, FLOOR = "nearest frame", "real"
# Frames that are scored: the translator's; its input; the target without contact; the target's
# training frame with the nearest motion; and the target's own frames: half of them against the
# other half, or against the simulator's ground truth.
METHODS = (TRANSLATED, SOURCE, REFERENCE, NEAREST, FLOOR)


@dataclass(frozen=True, slots=True)
class PairedScore:
    """Scores of frames against the true frames of the same press and phase."""

    role: str
    """Role of the presses in the split."""
    method: str
    """One of `METHODS`."""
    frames: int
    """Number of pairs."""
    dice: float
    """Mean Dice of the masks."""
    iou: float
    """Mean intersection over union of the masks."""
    ssim: float
    """Mean structural similarity of the images of 256 x 256 that networks see; NaN if unknown."""
    centroid_px: float
    """Median distance of matching markers [px]."""
    centroid_p95_px: float
    """Its 95th percentile [px]."""
    centroid_mm: float
    """Its median on the surface [mm]."""
    count_mismatch: float
    """Fraction of frames with a wrong number of markers."""
    area_ratio_error: float
    """Mean of |marker area / true marker area - 1|."""
    epe_px: float
    """Mean distance of markers from their true displaced positions [px]; NaN if unknown."""
    epe_mm: float
    """The same on the surface [mm]."""


@dataclass(frozen=True, slots=True)
class DistanceScore:
    """Distances between features of frames and of real frames of other presses."""

    role: str
    """Role of the presses in the split."""
    method: str
    """One of `METHODS`."""
    extractor: str
    """Extractor of the features, with the hash of its weights."""
    frechet: float
    kernel: float
    """Squared kernel distance, mean of random subsets."""
    kernel_std: float
    """Its standard deviation over the subsets."""
    mixing: float
    """Mixing of nearest neighbours: 1 is full, 0 none."""
    samples: int
    """Number of images on each side."""
    dimensions: int
    """Number of features."""
    seed: int
    """Seed of the halves and subsets."""


@dataclass(frozen=True, slots=True, eq=False)
class TranslationScores:
    """Scores of one translator between two sensors."""

    source: str
    """Sensor of the frames that were translated."""
    target: str
    """Sensor that they were translated to."""
    translator: str
    model: str
    """Hash of its weights."""
    paired: tuple[PairedScore, ...]
    distances: tuple[DistanceScore, ...]
    features: Mapping[str, NDArray[np.float32]]
    """Some features (n, d) of `SOURCE`, `TRANSLATED` and `FLOOR`, for plots."""

    def write(self, path: Path) -> None:
        """Write the scores as an .npz."""
        reported = {
            **{name: getattr(self, name) for name in _TEXTS},
            "paired": [_json_row(row) for row in self.paired],
            "distances": [_json_row(row) for row in self.distances],
        }
        write_results(path, Results(KIND, reported, dict(self.features)))


_TEXTS = ("source", "target", "translator", "model")


def read_scores(path: Path) -> TranslationScores:
    """Read scores from a file."""
    return scores_in(read_results(path), path)


def scores_in(results: Results, path: Path) -> TranslationScores:
    """Return the scores in a file's content; `path` is for error messages."""
    if results.kind != KIND:
        raise LearningError(f"{path}: found {results.kind}; allowed: {KIND}")
    reported = results.reported
    try:
        texts: dict[str, Any] = {name: str(reported[name]) for name in _TEXTS}
        return TranslationScores(
            **texts,
            paired=tuple(PairedScore(**_numbers(row, PairedScore)) for row in reported["paired"]),
            distances=tuple(
                DistanceScore(**_numbers(row, DistanceScore)) for row in reported["distances"]
            ),
            features=results.arrays,
        )
    except (KeyError, TypeError) as error:
        raise LearningError(f"{path}: found no translation scores: {error!r}") from None


def paired_rows(
    scores: Iterable[TranslationScores],
) -> tuple[tuple[TranslationScores, PairedScore], ...]:
    """Return the rows of paired frames without duplicates: they do not depend on the extractor."""
    distinct: dict[tuple[str, ...], tuple[TranslationScores, PairedScore]] = {}
    for one in scores:
        for row in one.paired:
            key = one.source, one.target, one.translator, row.role, row.method
            distinct.setdefault(key, (one, row))
    return tuple(distinct.values())


def score_line(one: TranslationScores, row: PairedScore | DistanceScore) -> dict[str, Any]:
    """Return a row of scores as a line of a CSV."""
    named = {"source": one.source, "target": one.target, "translator": one.translator}
    return {**named, **asdict(row)}


def require_alone(scores: Sequence[TranslationScores]) -> None:
    """Reject duplicate scores."""
    previous = set()
    for one in scores:
        for row in one.distances:
            key = one.source, one.target, one.translator, row.role, row.method, row.extractor
            if key in previous:
                raise LearningError(
                    f"translation scores: found {', '.join(key)} twice; allowed: once"
                )
            previous.add(key)


def _json_row(row: PairedScore | DistanceScore) -> dict[str, Any]:
    """Return a row as JSON values; NaN becomes null."""
    return {key: None if value != value else value for key, value in asdict(row).items()}


def _numbers(row: Mapping[str, Any], kind: type[PairedScore | DistanceScore]) -> dict[str, Any]:
    floats = {field.name for field in fields(kind) if field.type is float}
    return {
        key: float("nan") if value is None and key in floats else value
        for key, value in row.items()
    }


# Scoring of frames against the real frames of the same presses and phases.

Packed = NDArray[np.uint8]

_AT_ONCE = 64


class RealFrames:
    """Real frames of the target, the ground truth."""

    def __init__(self, sensor: ArchivedSensor, rows: Rows) -> None:
        """Load some rows (n,) of the target's table."""
        view = SensorView.of(sensor)
        self.sensor, self.rows = sensor, rows
        self.packed = sensor.packed(rows)
        """Their packed masks (n, 38400)."""
        self.mm = np.array([view.mm_per_column, view.mm_per_row])
        """Size of a pixel along columns and along rows (2,) [mm]."""
        check = sensor.attrs.get("marker_check") or {}
        self.smallest_px = int(check.get("smallest_px", SMALLEST_PX))
        """Minimum size of its markers [px]; smaller patches are ignored."""


def paired_score(packed: Packed, real: RealFrames, role: str, method: str) -> PairedScore:
    """Score frames (n, 38400) against the real ones of the same presses and phases."""
    scores, apart, missed = [], [], [np.empty((0, 2))]
    for first in range(0, len(packed), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        evaluated, true = unpack(packed[part]), unpack(real.packed[part])
        covered = overlap(evaluated, true)
        ssim = structural_similarity(shrink(packed[part]), shrink(real.packed[part]))
        offsets, wrong = marker_errors(evaluated, true, real.smallest_px)
        scores.append((covered.dice, covered.iou, ssim, covered.area_ratio_error, wrong))
        apart.append(offsets)
        if real.sensor.fields is not None:
            missed.append(_endpoint_errors(evaluated, real, part))
    dice, iou, ssim, areas, wrong = (np.concatenate(each) for each in zip(*scores, strict=True))
    offsets, epe = np.concatenate(apart), np.concatenate(missed)
    distance = np.linalg.norm(offsets, axis=1)
    return PairedScore(
        role=role,
        method=method,
        frames=len(packed),
        dice=float(dice.mean()),
        iou=float(iou.mean()),
        ssim=float(ssim.mean()),
        centroid_px=_quantile(distance, 0.5),
        centroid_p95_px=_quantile(distance, 0.95),
        centroid_mm=_quantile(np.linalg.norm(offsets * real.mm, axis=1), 0.5),
        count_mismatch=float(wrong.mean()),
        area_ratio_error=_mean(areas[np.isfinite(areas)]),
        epe_px=_mean(np.linalg.norm(epe, axis=1)),
        epe_mm=_mean(np.linalg.norm(epe * real.mm, axis=1)),
    )


def _endpoint_errors(evaluated: NDArray[np.bool_], real: RealFrames, part: slice) -> Floats:
    sensor, rows = real.sensor, real.rows[part]
    field = sensor.displacement(rows)
    reference = sensor.table["reference"][rows]
    missed = [np.empty((0, 2))]
    for number in np.unique(reference).tolist():
        here = reference == number
        no_contact = unpack(sensor.references[number])
        missed.append(
            endpoint_errors(
                evaluated[here], no_contact, field[here], sensor.lattice, real.smallest_px
            )
        )
    return np.concatenate(missed)


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _quantile(values: Floats, fraction: float) -> float:
    return float(np.quantile(values, fraction)) if len(values) else float("nan")


# Default maximum of scored pairs of a role, drawn at random.
FRAMES = 1000
# Samples in a subset of the kernel distance, and number of subsets.
SUBSET, SUBSETS = 500, 50
# Number of features that are kept of each side for plots.
SHOWN = 150
# Minimum number of locations for distances: six on each side.
LEAST = 12


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
    """Score translated frames `A-to-B`, the baselines and the lower bound, by role.

    At most `frames` location pairs of a role are scored, drawn by the seed; features for distances
    come from the extractor.
    """
    source, target = (_sensor_of(archive, translated, end) for end in ("source", "target"))
    split.check(archive)
    training = split.rows(target.table, "train")
    drawn = [_pairs(source, target, translated, split, role, frames, seed) for role in roles]
    paired: list[PairedScore] = []
    distances: list[DistanceScore] = []
    samples: dict[str, NDArray[np.float32]] = {}
    total = sum(5 * len(rows) for rows, _, _ in drawn)
    done = 0
    for role, (real_rows, source_rows, translated_rows) in zip(roles, drawn, strict=True):
        real = RealFrames(target, real_rows)
        by_method = {
            TRANSLATED: translated.packed(translated_rows),
            SOURCE: source.packed(source_rows),
            REFERENCE: target.references[target.table["reference"][real.rows]],
        }
        if len(training):
            by_method[NEAREST] = target.packed(nearest_frames(target.table, real.rows, training))
        by_method[FLOOR] = real.packed
        features = {}
        for method, packed in by_method.items():
            paired.append(paired_score(packed, real, role, method))
            features[method] = extractor.features(shrink(packed))
            done += len(real.rows)
            progress(done, total)
        location = target.table["location"][real.rows]
        halves = half_of_locations(location, seed)
        if len(np.unique(location)) >= LEAST:
            distances += _distances(features, halves, role, extractor.name, seed)
        for method in (SOURCE, TRANSLATED, FLOOR):
            there = halves if method == FLOOR else ~halves
            samples.setdefault(method, features[method][there][:SHOWN].astype(np.float32))
    progress(total, total)
    return TranslationScores(
        source.name,
        target.name,
        str(translated.attrs["model"]),
        str(translated.attrs.get("model_sha256", "")),
        tuple(paired),
        tuple(distances),
        samples,
    )


def half_of_locations(location: NDArray[np.integer], seed: int) -> NDArray[np.bool_]:
    """Return True for frames (n,) in the half of the locations that real frames are taken from.

    Evaluated frames come from the other half, so that none is compared with its own counterpart.
    """
    different = np.unique(location)
    chosen = np.random.default_rng(seed).permutation(different)[: len(different) // 2]
    return np.isin(location, chosen)


def _pairs(
    source: ArchivedSensor,
    target: ArchivedSensor,
    translated: ArchivedSensor,
    split: Split,
    role: Role,
    frames: int,
    seed: int,
) -> tuple[Rows, Rows, Rows]:
    """Return corresponding rows of the target, the source and the translated frames."""
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
    return real[of_role], before.source[one[of_role]], after.source[other[of_role]]


def _sensor_of(archive: MarkerArchive, translated: ArchivedSensor, end: str) -> ArchivedSensor:
    name = translated.attrs.get(end)
    if "model" not in translated.attrs or name not in archive:
        raise LearningError(
            f"{translated.name}: found {end} {name!r}; allowed: frames translated from and to "
            f"sensors of {archive.name}: {', '.join(archive)}"
        )
    return archive[str(name)]


def _distances(
    features: dict[str, Floats], halves: NDArray[np.bool_], role: str, extractor: str, seed: int
) -> list[DistanceScore]:
    """Return the distances of frames of each method from real ones of other presses."""
    real = features[FLOOR][halves]
    neighbours = min(NEIGHBOURS, len(halves) - 1)
    scores = []
    for method, values in features.items():
        other = values[~halves]
        kernel, spread = kernel_distance(real, other, size=SUBSET, subsets=SUBSETS, seed=seed)
        scores.append(
            DistanceScore(
                role=role,
                method=method,
                extractor=extractor,
                frechet=frechet_distance(real, other),
                kernel=kernel,
                kernel_std=spread,
                mixing=mixing_score(real, other, neighbours),
                samples=min(len(real), len(other)),
                dimensions=real.shape[1],
                seed=seed,
            )
        )
    return scores
