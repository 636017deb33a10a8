"""Forces of two fingers by balance and known weights alone: one curve each, from signal to newtons.

Balance says that the forces of both fingers on one object differ by its weight's component along
the grip axis. Without such weights it leaves a common monotone function free; a known weight, on
one finger and then on the other at the same steps, fixes it at the forces of these steps.

Both signals have errors. Least squares would shrink the curves, as errors of signals then look like
signals (errors in variables). So residuals of the balance are made orthogonal to what has no error:
the steps, and the weights at the steps (instrumental variables). Errors of the curves are those of
leaving objects out one by one (jackknife).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from learning.errors import LearningError
from learning.force.intervals import COVERAGE, AxisError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Powers of the signal that a curve begins with; below this part of the largest signal it is linear.
POWERS, LINEAR = np.array([0.75, 1.0, 1.5]), 0.01
# Pieces of the correction of each curve, and the penalty on its bends.
PIECES, BENDS = 6, 0.1
# Steps of the squeeze that are told apart; fewest at which weights differ.
STEPS, FEWEST = 5, 5
# Error of a balance without force, over that at the largest one.
LEAST_ERROR = 0.05
# Forces, over the largest, at which errors are taken.
AT = np.linspace(0.1, 1.0, 10)


@dataclass(frozen=True, slots=True, eq=False)
class Balanced:
    """Signals of two fingers on n squeezed objects, 0 without contact, and the known difference."""

    signals: Floats
    """Signal of either finger (2, n), increasing with the normal force."""
    weight: Floats
    """Force on the first finger less that on the second (n,) [N]."""
    step: Integers
    """Step of the squeeze (n,)."""
    object: Integers
    """Number of the object (n,)."""

    def only(self, chosen: NDArray[np.bool_]) -> Self:
        """Return some of them."""
        return type(self)(
            self.signals[:, chosen], self.weight[chosen], self.step[chosen], self.object[chosen]
        )

    def require_weights(self) -> None:
        """Reject squeezes from which no newtons follow."""
        steps, objects = np.unique(self.step), len(np.unique(self.object))
        loaded = [step for step in steps if np.ptp(self.weight[self.step == step]) > 0]
        if len(loaded) < FEWEST or objects < 2:
            raise LearningError(
                f"squeezes: found {objects} objects, and {len(loaded)} of {len(steps)} steps at "
                f"which known weights load the fingers differently; allowed: two objects and "
                f"{FEWEST} steps or more, with the weight on either finger (turn x = 1 and -1); or "
                "--source-model"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Normal force of a finger by its signal."""

    largest: float
    """Largest signal learned from."""
    powers: Floats
    """Powers of the signal over the largest one, that it begins with (q,)."""
    coefficients: Floats
    """Of these (q,) [N]."""
    knots: Floats
    """Forces by these powers, from 0 (p + 1,) [N]."""
    forces: Floats
    """Forces at the knots but the first (p,) [N], linear from one to the next and beyond."""

    def __call__(self, signals: Floats) -> Floats:
        """Return the forces (n,) [N] at signals (n,)."""
        start = _raised(signals / self.largest, self.powers) @ self.coefficients
        return np.asarray(_hats(start, self.knots) @ self.forces)


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """Curves of both fingers, and their errors."""

    curves: tuple[Curve, Curve]
    forces: Floats
    """Forces of either finger (2, 10) [N] at which the errors are."""
    half_width: Floats
    """Half-widths of 90 % intervals of these (2, 10) [N]."""

    def error(self, finger: int) -> AxisError:
        """Return the lowest line above the half-widths of a finger."""
        force, half = self.forces[finger], self.half_width[finger]
        slopes = np.linspace(0.0, (half / force).max(), 50)
        bases = np.maximum((half - slopes[:, None] * force).max(axis=1), 0.0)
        best = int(np.argmin(bases + slopes * force.mean()))
        return AxisError(float(bases[best]), float(slopes[best]))


def weigh_balanced(some: Balanced) -> Weighed:
    """Return the curves of both fingers.

    Raises:
        LearningError: Too few weights, or curves that do not rise with the signal.
    """
    some.require_weights()
    curves = _fit(some)
    at = np.quantile(some.signals, 0.98, axis=1)[:, None] * np.linspace(0.05, 1.0, 40)
    forces = _at(curves, at)
    if not (np.diff(forces, axis=1) > 0).all():
        raise LearningError(
            "squeezes: found signals from which no rising force follows; allowed: weights and "
            "steps that the fingers feel clearly, on more objects or turns"
        )
    wanted = forces[:, -1:] * AT
    at = np.stack([np.interp(*each) for each in zip(wanted, forces, at, strict=True)])
    objects = np.unique(some.object)
    left_out = np.stack([_at(_fit(some.only(some.object != one)), at) for one in objects])
    degrees = len(objects) - 1
    error = np.sqrt(degrees * left_out.var(axis=0))
    half = float(student.ppf(0.5 + COVERAGE / 2, degrees)) * error
    return Weighed(curves, _at(curves, at), half)


def straight(some: Balanced) -> tuple[Curve, Curve]:
    """Return lines in place of curves, for signals whose errors are still large."""
    some.require_weights()
    return _fit(some, np.ones(1), 1e3)


def _at(curves: tuple[Curve, Curve], signals: Floats) -> Floats:
    """Return the forces of both fingers (2, n) [N] at signals (2, n)."""
    return np.stack([curve(own) for curve, own in zip(curves, signals, strict=True)])


def _fit(some: Balanced, powers: Floats = POWERS, stiff: float = BENDS) -> tuple[Curve, Curve]:
    """Return curves for which the balance has no part along the instruments."""
    largest = some.signals.max(axis=1)
    relative = some.signals / largest[:, None]
    steps, of_step = np.unique(some.step, return_inverse=True)
    size = np.array([relative[:, some.step == step].mean() for step in steps])
    precision = 1.0 / (LEAST_ERROR + size[of_step])
    # Steps, and weights at the steps, have no error.
    at = np.linspace(steps[0], steps[-1], STEPS)
    near = np.maximum(1 - np.abs(some.step[:, None] - at) / (at[1] - at[0]), 0.0)
    instruments = np.hstack([near, some.weight[:, None] * near])
    basis, _ = np.linalg.qr(instruments * precision[:, None])

    def solved(parts: list[Floats], penalty: Floats) -> list[Floats]:
        columns = np.hstack([parts[0], -parts[1]]) * precision[:, None]
        rows = np.vstack([basis.T @ columns, penalty])
        wanted = np.r_[basis.T @ (some.weight * precision), np.zeros(len(penalty))]
        scale = np.linalg.norm(rows, axis=0)
        return np.split(np.linalg.lstsq(rows / scale, wanted, rcond=None)[0] / scale, 2)

    raised = [_raised(each, powers) for each in relative]
    coefficients = solved(raised, np.zeros((0, 2 * len(powers))))
    starts = [each @ own for each, own in zip(raised, coefficients, strict=True)]
    knots = [np.linspace(0.0, max(each.max(), 1e-9), PIECES + 1) for each in starts]
    bends = stiff * PIECES * np.diff(np.eye(PIECES + 1), 2, axis=0)[:, 1:]
    hats = [_hats(*each) for each in zip(starts, knots, strict=True)]
    forces = solved(hats, np.asarray(np.kron(np.eye(2), bends)))
    own, other = (
        Curve(float(largest[k]), powers, coefficients[k], knots[k], forces[k]) for k in (0, 1)
    )
    return own, other


def _raised(relative: Floats, powers: Floats) -> Floats:
    """Return powers (n, q) of signals (n,) over the largest one, linear and odd about 0."""
    some = relative[:, None]
    return np.where(
        some > LINEAR, np.maximum(some, LINEAR) ** powers, some * LINEAR ** (powers - 1)
    )


def _hats(values: Floats, knots: Floats) -> Floats:
    """Return weights (n, p) of the knots at values (n,); at the first knot functions are 0."""
    at = np.clip(np.searchsorted(knots, values) - 1, 0, len(knots) - 2)
    part = (values - knots[at]) / (knots[at + 1] - knots[at])
    weights = np.zeros((len(values), len(knots)))
    rows = np.arange(len(values))
    weights[rows, at], weights[rows, at + 1] = 1 - part, part
    return weights[:, 1:]
