"""Intervals of predicted forces: how far off a model may be, by axis and frame.

A half-width has two parts, which are added as squares:

- the **error of the model**: the quantile of its errors on indenters that it never saw, measured
  on frames of the target (split-conformal prediction). It grows with the predicted force.
- the **scale**: the modulus of a skin that was never pressed against a known force is not known.
  Its factor is a log-normal prior, stated in words; a weight or labels make it narrow.

The numbers are a file beside the model, `intervals.json`; reading it needs numpy alone.
"""

import functools
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from learning.config import READER
from learning.errors import LearningError
from recorder.store import replace_file

Floats = NDArray[np.float64]

FILE = "intervals.json"
FORMAT, FORMAT_VERSION = "tactile-rig intervals", 2
# Fraction of the true forces that intervals shall contain.
COVERAGE = 0.9
# Quantile of the normal distribution at either end of such an interval.
NORMAL = 1.6449
# Fewest errors to calibrate from: below, no quantile of 90 % exists.
FEWEST = 10
# Fewest indenters whose errors have a quantile of 90 %; with fewer, indenters are assumed to differ
# in the size of their errors by this standard deviation of the logarithm.
FEWEST_INDENTERS, INDENTER_SPREAD = 9, 0.2


@dataclass(frozen=True, slots=True)
class Scale:
    """Log-normal factor between predicted and true forces."""

    factor: float
    """The true force is within 1 / factor and factor times the predicted one, at 90 %."""
    source: str
    """Source of this knowledge, as a clause."""
    assumed: bool
    """True if no force on the sensor was ever known."""

    def __post_init__(self) -> None:
        if not 1.0 <= self.factor < math.inf:
            raise LearningError(f"scale.factor: found {self.factor}; allowed: 1 or more")

    @property
    def spread(self) -> float:
        """Standard deviation of the logarithm."""
        return math.log(self.factor) / NORMAL


@dataclass(frozen=True, slots=True)
class AxisError:
    """Error of a model along an axis on unseen indenters, 90 % of frames: base + slope x force."""

    base: float
    """At no force [N]."""
    slope: float
    """By newton of the magnitude of the predicted force."""


def both(one: AxisError | None, other: AxisError | None) -> AxisError | None:
    """Return a line above two independent errors, which add as squares; None without the first."""
    if one is None or other is None:
        return one
    return AxisError(math.hypot(one.base, other.base), math.hypot(one.slope, other.slope))


def errors_at(axes: Sequence[AxisError | None], forces: Floats) -> Floats:
    """Return the errors of a model's forces (n, 3) [N]; NaN on axes that are not measured."""
    base, slope = (
        np.array([np.nan if one is None else getattr(one, name) for one in axes])
        for name in ("base", "slope")
    )
    magnitude = np.sqrt(np.nansum(np.square(forces), axis=1))
    return np.asarray(base + slope * magnitude[:, None])


@dataclass(frozen=True)
class LearnedShapes:
    """Shapes of the frames that a model learned from."""

    units: tuple[tuple[float, ...], ...]
    """Matrix (7, 7) that multiplies shapes, after which learned ones have unit covariance."""
    shapes: tuple[tuple[float, ...], ...]
    """Shapes of some of the frames (k, 7), multiplied."""
    limit: float
    """Distance above which a frame is outside."""

    @functools.cached_property
    def _arrays(self) -> tuple[Floats, Floats]:
        return np.array(self.units, np.float64), np.array(self.shapes, np.float64)

    def distances(self, shapes: Floats) -> Floats:
        """Return the distance of shapes (n, 7) from the nearest learned one (n,)."""
        units, learned = self._arrays
        squares = [
            np.square(shape - learned).sum(axis=1).min()
            for shape in np.asarray(shapes, np.float64) @ units
        ]
        return np.sqrt(np.array(squares, np.float64))

    def is_far(self, shapes: Floats) -> NDArray[np.bool_]:
        """Return True for shapes (n, 7) that are beyond the limit."""
        return np.asarray(self.distances(shapes) > self.limit, np.bool_)


@dataclass(frozen=True, slots=True)
class Intervals:
    """Intervals of a force model, for one target sensor."""

    axes: tuple[AxisError | None, AxisError | None, AxisError | None]
    """Fx, Fy, Fz; None: not measured."""
    scale: Scale
    largest: tuple[float | None, float | None, float | None]
    """Largest absolute force learned from, of Fx, Fy, Fz [N]."""
    learned: LearnedShapes
    """Shapes of the target's frames learned from."""
    frames: int
    """Number of frames calibrated from."""
    indenters: tuple[str, ...]
    """Indenters calibrated from, which the model had not seen by then."""
    errors_from: str
    """Name of the forces that predicted ones were compared with."""

    def of(self, forces: Floats) -> tuple[Floats, Floats]:
        """Return both ends (n, 3) [N] of the intervals of forces (n, 3); NaN if not calibrated."""
        forces = np.asarray(forces, np.float64).reshape(-1, 3)
        error = errors_at(self.axes, forces)
        size = np.abs(forces)
        outward = np.hypot(error, size * (self.scale.factor - 1.0))
        inward = np.hypot(error, size * (1.0 - 1.0 / self.scale.factor))
        negative = forces < 0
        low = forces - np.where(negative, outward, inward)
        high = forces + np.where(negative, inward, outward)
        return low, high

    def is_outside(self, forces: Floats, shapes: Floats) -> NDArray[np.bool_]:
        """Return True for forces (n, 3) [N] and shapes (n, 7) beyond those that were learned."""
        largest = np.array([np.inf if one is None else one for one in self.largest])
        beyond = (np.abs(np.asarray(forces).reshape(-1, 3)) > largest).any(axis=1)
        return np.asarray(beyond | self.learned.is_far(shapes), np.bool_)

    def rescaled(self, value: float | Sequence[float], scale: Scale) -> Self:
        """Return the intervals of a model whose forces are multiplied by a value, or one an axis.

        The slope is by newton of all three: on an axis that grows more than Fz it grows as well.
        """
        gain = [float(each) for each in np.broadcast_to(value, 3)]
        axes = [
            None if one is None else AxisError(g * one.base, g / gain[2] * one.slope)
            for g, one in zip(gain, self.axes, strict=True)
        ]
        largest = [
            None if one is None else g * one for g, one in zip(gain, self.largest, strict=True)
        ]
        return replace(
            self,
            axes=(axes[0], axes[1], axes[2]),
            largest=(largest[0], largest[1], largest[2]),
            scale=scale,
        )

    def write(self, folder: Path) -> None:
        """Write the file into a model's folder, atomically."""
        content = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "coverage": COVERAGE,
            "units": "base and largest N; slope 1; learned 1",
            **asdict(self),
        }
        replace_file(folder / FILE, (json.dumps(content, indent=1) + "\n").encode())


def read_intervals(folder: Path) -> Intervals | None:
    """Read the intervals of the model in a folder; None if it has none."""
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        header = tuple(content.pop(key) for key in ("format", "format_version", "coverage"))
        del content["units"]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as error:
        raise LearningError(f"{path}: damaged: {error!r}") from None
    if header != (FORMAT, FORMAT_VERSION, COVERAGE):
        raise LearningError(
            f"{path}: found format {header}; allowed: {(FORMAT, FORMAT_VERSION, COVERAGE)}; "
            "repeating the `tactile force` that made it writes it again"
        )
    return READER.build(Intervals, content, str(path))


# Calibration: from errors on unseen indenters to half-widths.


def fit_errors(
    predicted: Floats, wanted: Floats, indenter: NDArray[np.str_]
) -> tuple[AxisError | None, AxisError | None, AxisError | None]:
    """Return the error of each axis that 90 % of a new indenter's frames stay below.

    The half-width's shape, a base and a slope, is a least-squares fit of the absolute errors over
    the magnitude of the predicted force. Its size is split-conformal: the 90 % quantile of the
    errors over that fit, in which each indenter counts alike, however many frames it has. Frames of
    one indenter err alike, so with fewer than 9 indenters it is multiplied by a factor
    (`beyond_largest`), as a new one may err more than all of these. Forces (n, 3) [N] are on frames
    of indenters (n,) that the model never saw; NaN is no label. An axis with fewer than `FEWEST`
    errors has None.
    """
    magnitude = np.sqrt(np.nansum(np.asarray(predicted, np.float64) ** 2, axis=1))
    errors: list[AxisError | None] = []
    for axis in range(3):
        error = np.abs(predicted[:, axis] - wanted[:, axis])
        labelled = np.isfinite(error)
        if labelled.sum() < FEWEST:
            errors.append(None)
            continue
        error, size = error[labelled], magnitude[labelled]
        base, slope = _line(size, error)
        ratio, names = error / (base + slope * size), indenter[labelled]
        _, group, count = np.unique(names, return_inverse=True, return_counts=True)
        quantile = _conformal(ratio, 1.0 / count[group]) * beyond_largest(len(count))
        errors.append(AxisError(quantile * base, quantile * slope))
    return errors[0], errors[1], errors[2]


def _conformal(values: Floats, weights: Floats) -> float:
    """Return the value below which 90 % of the weights are, counting one more that is larger."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    wanted = COVERAGE * below[-1] * (1.0 + 1.0 / len(values))
    rank = min(len(values) - 1, int(np.searchsorted(below, wanted * (1 - 1e-12))))
    return float(values[order][rank])


@functools.cache
def beyond_largest(count: int) -> float:
    """Return the factor on the largest error of some indenters that 90 % of new ones stay below.

    Errors of indenters are assumed to be log-normal, with `INDENTER_SPREAD`: 1.44 for one
    indenter, 1.16 for three, 1 for nine and more.
    """
    if count >= FEWEST_INDENTERS:
        return 1.0
    at = np.linspace(-6, 6, 2001)
    density = np.exp(-(at**2) / 2) / math.sqrt(2 * math.pi)
    below = np.cumsum(density) * (at[1] - at[0])
    largest = count * below ** (count - 1) * density
    steps = np.linspace(0, 3, 601)
    chance = [
        float(np.sum(largest * np.interp(at + step, at, below)) * (at[1] - at[0])) for step in steps
    ]
    return math.exp(INDENTER_SPREAD * float(np.interp(COVERAGE, chance, steps)))


def _line(size: Floats, error: Floats) -> tuple[float, float]:
    """Return base and slope, neither below 0, of the least-squares line of errors over sizes."""
    mean = float(error.mean())
    varied = float(np.square(size - size.mean()).sum())
    slope = float(((size - size.mean()) * error).sum()) / varied if varied > 0 else 0.0
    slope = max(0.0, slope)
    base = mean - slope * float(size.mean())
    if base <= 0:
        slope = float((size * error).sum()) / float((size**2).sum())
        base = 0.0
    # An error of 0 N at no force would promise more than any number of frames can show.
    return max(base, 0.1 * mean, 1e-6), slope


# Scale: the factor between predicted and true forces, by forces that are known.


@dataclass(frozen=True, slots=True)
class ScaleSample:
    """A true force, such as a weight's, and the one that the model predicts."""

    true: float
    """True force along an axis [N]."""
    predicted: float
    """Predicted one [N]."""
    error: float
    """Error that the model may make there, at 90 % [N]."""


def measured_scale(
    samples: Sequence[ScaleSample], prior: Scale, source: str, *, independent: int = 1
) -> tuple[float, Scale]:
    """Return the factor on predicted forces, and its remaining uncertainty.

    The factor is the geometric mean of true over predicted forces, each with the inverse square of
    its relative error as weight: where errors grow with the force, the strongest counts no more
    than others. Prior and measurement are combined by their precision (both are log-normal):
    weights that are too light for the model to see change little. `independent` is the number of
    presses with an error of their own: weights on one indenter have the same error, which does not
    average out. `source` names the source of what is then known.
    """
    if not samples:
        raise LearningError("weights: found none; allowed: one or more")
    true, predicted, error = np.array([(s.true, s.predicted, s.error) for s in samples]).T
    if not (true * predicted > 0).all():
        wrong = int(np.flatnonzero(~(true * predicted > 0))[0])
        raise LearningError(
            f"weight {wrong + 1}: its force is {true[wrong]:.3f} N and the model predicts "
            f"{predicted[wrong]:.3f} N; allowed: forces of the same sign (pressing is negative "
            "Fz); was the weight at rest on the sensor?"
        )
    spreads = np.log1p(np.maximum(error / np.abs(predicted), 1e-9)) / NORMAL
    shares = spreads**-2 / (spreads**-2).sum()
    ratio = math.exp(float((shares * np.log(true / predicted)).sum()))
    own = float((shares * spreads).sum()) / math.sqrt(independent)
    both = prior.spread**2 + own**2
    weight = prior.spread**2 / both if both > 0 else 1.0
    value = math.exp(weight * math.log(ratio))
    spread = math.sqrt(weight) * own
    return value, Scale(math.exp(NORMAL * spread), source, assumed=False)


# Frames that a model learned from, by the shape of their markers: others far from all are flagged.
#
# The shape of a frame is some numbers of its markers: how far they moved, and how unevenly, and how
# much of the image they cover, in all and by parts of it; of shading, the size of its changes. The
# distance of a frame is that to the nearest learned one, in units in which learned frames have unit
# covariance.

# Count of numbers in a shape.
SHAPE = 7
# Cells down and across the image, in which markers are counted; coarse ones are 2 x 2 of these.
_CELLS = 8
# Share of the frames of indenters that were held out that may be flagged.
FLAGGED = 0.01
# Number of learned frames that are kept.
_KEPT = 1000
# Share of each number's variance that is added to it: few frames may not vary in all directions.
_RIDGE, _LEAST = 1e-3, 1e-8


def learned_within(learned: Floats, pairs: Sequence[tuple[Floats, Floats]]) -> LearnedShapes:
    """Return what was learned (n, 7), with a limit by pairs of learned and held-out shapes.

    Each held-out shape (m, 7) is compared with those that were learned without it.
    """
    distances = np.sort(np.concatenate([_unlimited(own).distances(out) for own, out in pairs]))
    rank = min(len(distances), math.ceil((1 - FLAGGED) * (len(distances) + 1)))
    return replace(_unlimited(learned), limit=float(distances[rank - 1]))


def _unlimited(learned: Floats) -> LearnedShapes:
    covariance = np.cov(learned.T)
    ridge = np.diag(_RIDGE * np.diag(covariance) + _LEAST)
    units = np.linalg.cholesky(np.linalg.inv(covariance + ridge))
    chosen = np.unique(np.linspace(0, len(learned) - 1, _KEPT).round().astype(int))
    return LearnedShapes(_rows(units), _rows((learned[chosen] @ units).round(4)), math.inf)


def _rows(matrix: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def shapes_of(masks: NDArray[np.bool_], reference: NDArray[np.bool_]) -> Floats:
    """Return the shapes (n, 7) of frames (n, 480, 640), by the mask without contact (480, 640).

    Relative to the reference's markers per cell: mean and standard deviation over cells of their
    motion [px], standard deviation of the change of their area, its least and most in coarse cells;
    then their share of the image [%], and the length of their edges over that of an image [px of
    its width].
    """
    edge, area = _of_reference(reference.tobytes(), reference.shape)
    shapes = np.zeros((len(masks), SHAPE))
    for row, mask in zip(shapes, masks, strict=True):
        moved = _cells(mask != reference) / edge
        grown = (_cells(mask) - area) / area.mean()
        coarse = grown.reshape(_CELLS // 2, 2, _CELLS // 2, 2).mean(axis=(1, 3))
        row[:] = (
            moved.mean(),
            moved.std(),
            grown.std(),
            coarse.min(),
            coarse.max(),
            100.0 * np.count_nonzero(mask) / mask.size,
            edge_length(mask) / mask.shape[1],
        )
    return shapes


def shapes_of_shading(frames: NDArray[np.uint8]) -> Floats:
    """Return the shapes (n, 7) of frames (n, 3, 128, 128) of shading [grey levels].

    By colour the spread of the change and its mean step from cell to cell (4 x 4 px); then the 99th
    percentile of these steps.
    """
    shapes = np.zeros((len(frames), SHAPE))
    for row, frame in zip(shapes, frames, strict=True):
        side = frame.shape[-1] // 4
        change = frame.reshape(3, side, 4, side, 4).mean(axis=(2, 4))
        down, across = np.diff(change, axis=1)[:, :, :-1], np.diff(change, axis=2)[:, :-1]
        steps = np.hypot(down, across).reshape(3, -1)
        row[:3] = change.reshape(3, -1).std(axis=1)
        row[3:6] = steps.mean(axis=1)
        row[6] = np.percentile(steps.mean(axis=0), 99)
    return shapes


def edge_length(mask: NDArray[Any]) -> int:
    """Return the number of sides between marker pixels and background pixels of a mask (h, w)."""
    across = np.count_nonzero(mask[:, 1:] != mask[:, :-1])
    down = np.count_nonzero(mask[1:] != mask[:-1])
    return int(across + down)


@functools.lru_cache(maxsize=4)
def _of_reference(stored: bytes, shape: tuple[int, ...]) -> tuple[float, Floats]:
    """Return length of edges and area of markers by cell of a reference."""
    reference = np.frombuffer(stored, np.bool_).reshape(shape)
    return edge_length(reference) / _CELLS**2, _cells(reference)


def _cells(mask: NDArray[np.bool_]) -> Floats:
    """Return the number of marker pixels by cell (8, 8)."""
    high, wide = mask.shape[0] // _CELLS, mask.shape[1] // _CELLS
    rows = np.add.reduceat(mask.view(np.uint8), np.arange(0, mask.shape[0], high), 0, np.uint16)
    return np.add.reduceat(rows, np.arange(0, mask.shape[1], wide), 1, np.float64)
