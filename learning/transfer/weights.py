"""Forces of two fingers by balance and known weights alone: one curve each, from signal to newtons.

Balance alone leaves a common monotone function free. A known weight, on one finger and then on the
other at the same steps, fixes it at these. Both signals have errors, by which least squares would
shrink the curves. So residuals of the balance are made orthogonal to what has no error: the steps,
and the weights at the steps (instrumental variables). Errors of the curves are those of leaving
objects out one by one (jackknife).
"""

from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.force.intervals import AxisError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Curves = list[partial[Floats]]

# Powers of the signal that a curve begins with; below this part of the largest signal it is linear.
POWERS, LINEAR = np.array([0.75, 1.0, 1.5]), 0.01
# Pieces of the correction of each curve, and the penalty on its bends.
PIECES, BENDS = 6, 0.1
# Steps of the squeeze that differ; fewest at which weights do, by how much at least [N].
STEPS, FEWEST, DIFFER = 5, 5, 0.1
# Error of a balance without force, over that at the largest one.
LEAST_ERROR = 0.05
# Quantile of 95 % of Student's distribution, by one over the degrees of freedom.
STUDENT = (0.0, 0.1, 0.2, 1 / 3, 0.5), (1.645, 1.812, 2.015, 2.353, 2.920)
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
        loaded = [step for step in steps if np.ptp(self.weight[self.step == step]) > DIFFER]
        if len(loaded) < FEWEST or objects < 3:
            raise LearningError(
                f"squeezes: found {objects} objects, and {len(loaded)} of {len(steps)} steps with "
                f"weights on both fingers (turn x = 1 and -1); allowed: 3 objects and {FEWEST} "
                "steps or more, or --source-model"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """Curves of both fingers, and their errors."""

    curves: Curves
    """Functions that return forces (n,) [N] at signals (n,)."""
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
    forces = forces_by(curves, at)
    _require_rising(np.diff(forces, axis=1))
    wanted = forces[:, -1:] * AT
    at = np.stack([np.interp(*each) for each in zip(wanted, forces, at, strict=True)])
    objects = np.unique(some.object)
    left_out = np.stack([forces_by(_fit(some.only(some.object != one)), at) for one in objects])
    degrees = len(objects) - 1
    half = np.interp(1 / degrees, *STUDENT) * np.sqrt(degrees * left_out.var(axis=0))
    return Weighed(curves, forces_by(curves, at), half)


def straight(some: Balanced) -> Floats:
    """Return the factors (2,) [N] of lines in place of curves, while errors are still large."""
    some.require_weights()
    signals = [signal[:, None] for signal in some.signals]
    factors = np.concatenate(_solved(some, signals, np.zeros((0, 2))))
    _require_rising(factors)
    return factors


def _require_rising(slopes: Floats) -> None:
    if not (slopes > 0).all():
        raise LearningError(
            "squeezes: found signals that do not rise with the force; allowed: masses and turns as "
            "they were (x from the left finger to the right one), felt clearly, on more objects"
        )


def forces_by(curves: Curves, signals: Floats) -> Floats:
    """Return the forces of both fingers (2, n) [N] at signals (2, n)."""
    return np.stack([curve(own) for curve, own in zip(curves, signals, strict=True)])


def _fit(some: Balanced) -> Curves:
    """Return the curves by some squeezes: powers, and bends that correct them."""
    largest = some.signals.max(axis=1)
    raised = [_raised(signal) for signal in some.signals / largest[:, None]]
    first = _solved(some, raised, np.zeros((0, 2 * len(POWERS))))
    starts = [each @ own for each, own in zip(raised, first, strict=True)]
    ends = [max(each.max(), 1e-9) for each in starts]
    knots = [end * np.arange(1, PIECES) / PIECES for end in ends]
    ramps = [_ramps(*each) for each in zip(starts, knots, strict=True)]
    bends = BENDS * np.diag([each for end in ends for each in (0.0, *[end] * (PIECES - 1))])
    slopes = _solved(some, ramps, bends)
    return [partial(_curve, *each) for each in zip(largest, first, knots, slopes, strict=True)]


def _curve(largest: float, first: Floats, knots: Floats, slopes: Floats, signals: Floats) -> Floats:
    """Return forces (n,) [N] at signals (n,): linear from knot to knot and beyond the last."""
    return np.asarray(_ramps(_raised(signals / largest) @ first, knots) @ slopes)


def _solved(some: Balanced, parts: list[Floats], penalty: Floats) -> list[Floats]:
    """Return the weights of both fingers' functions (n, m) with no balance along instruments."""
    size = (some.signals / some.signals.max(axis=1)[:, None]).mean(axis=0)
    steps, of_step = np.unique(some.step, return_inverse=True)
    precision = 1.0 / (LEAST_ERROR + (np.bincount(of_step, size) / np.bincount(of_step))[of_step])
    at = np.linspace(steps[0], steps[-1], STEPS)
    near = np.maximum(1 - np.abs(some.step[:, None] - at) / (at[1] - at[0]), 0.0)
    instruments = np.hstack([near, some.weight[:, None] * near])
    basis, _ = np.linalg.qr(instruments * precision[:, None])
    rows = basis.T @ (np.hstack([parts[0], -parts[1]]) * precision[:, None])
    wanted = basis.T @ (some.weight * precision)
    rows, wanted = np.vstack([rows, penalty]), np.r_[wanted, np.zeros(len(penalty))]
    scale = np.linalg.norm(rows, axis=0)
    return np.split(np.linalg.lstsq(rows / scale, wanted, rcond=None)[0] / scale, 2)


def _raised(relative: Floats) -> Floats:
    """Return `POWERS` (n, 3) of signals (n,) over the largest one, linear and odd about 0."""
    some, large = relative[:, None], np.maximum(relative, LINEAR)[:, None]
    return np.asarray(large**POWERS - (large - some) * LINEAR ** (POWERS - 1))


def _ramps(values: Floats, knots: Floats) -> Floats:
    """Return functions (n, p) of values (n,), each of which bends at a knot but the first."""
    column = values[:, None]
    return np.hstack([column, np.maximum(column - knots, 0.0)])
