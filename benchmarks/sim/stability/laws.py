"""Laws of mechanics that any press must keep: each is a measured number and its limit.

A limit is stated where a law is used, with its reason: what the mesh, the tolerance or float32 lets
one expect, and a factor of 2 to 5 above what is measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.result import Result

Array = NDArray[np.float64]

# Base reaction against contact force: the solver accepts nodal forces that are out of balance by
# 1e-4 of the contact's (l2); summed over the nodes they may add up to a few times that.
BALANCE = 5e-4
# Contact lighter than this share of the press's largest is balanced to that share: the solver asks
# for no more digits of a touch than float32 has.
LIGHT = 0.01
# Shear traction over the friction limit, in the largest pressure: the last digits of float32.
SLIP = 1e-5
# Symmetry of displacements relative to the largest: float32 has 6e-8, sums of some 1e5 terms and a
# conjugate gradient that amplifies them lose two to three digits.
LAST_DIGITS = 2e-5
# Two ways to one elastic state, relative force: each is accepted 1e-4 out of balance.
SAME = 5e-4


@dataclass(frozen=True, slots=True)
class Law:
    """What must hold, what was measured, and the limit it is held to."""

    says: str
    """What is measured, in words."""
    measured: float
    sense: Literal["<=", ">="]
    limit: float

    @property
    def holds(self) -> bool:
        """Whether the measured number keeps to its limit; never when it is not a number."""
        if not math.isfinite(self.measured):
            return False
        return self.measured <= self.limit if self.sense == "<=" else self.measured >= self.limit

    def __str__(self) -> str:
        return f"{self.says}: {self.measured:.3g} {self.sense} {self.limit:.3g}"


def escaped(text: str) -> str:
    """A law's words for a cell of a Markdown table."""
    plain = text.replace("<=", "≤").replace(">=", "≥").replace("<", "&lt;")
    return plain.replace("|", "\\|")


def at_most(says: str, measured: float, limit: float) -> Law:
    """The law that a number is at most `limit`."""
    return Law(says, float(measured), "<=", limit)


def at_least(says: str, measured: float, limit: float) -> Law:
    """The law that a number is at least `limit`."""
    return Law(says, float(measured), ">=", limit)


def sound(*results: Result, det_f: float = 0.1, pull: float = 1e-6) -> list[Law]:
    """Nothing inverted, forces in balance, and no pull: what every press must keep.

    `det_f` is the smallest determinant of the deformation gradient; the solver's own floor is 0.05.
    `pull` is the largest upward traction: none, unless friction above 1 holds a steep flank.
    """
    pulls, unbalanced = [], []
    for result in results:
        push = -result.traction[..., 2].astype(float)
        pulls.append(max(0.0, -push.min()) / max(float(np.abs(push).max()), 1e-30))
        force = np.linalg.norm(result.force, axis=1)
        share = force / max(float(force.max()) * LIGHT, 1e-30)
        unbalanced.append(result.quality.balance * np.minimum(1.0, share))
    return [
        at_least("smallest det F", _least(r.quality.det_f_min for r in results), det_f),
        at_most("balance", _most(unbalanced), BALANCE),
        at_most("tension / largest pressure", max(pulls), pull),
    ]


def conserves(result: Result, limit: float) -> Law:
    """Elastic and frictionless: in the end, what was put in is stored, or was given back."""
    gap = abs(result.quality.energy_gap[-1])
    return at_most("|work - stored energy| / work", gap, limit)


def dissipates(result: Result, limit: float) -> Law:
    """Passive: never is more given back than was put in."""
    least = result.quality.energy_gap.min()
    return at_least("(work - stored energy) / work, least", least, -limit)


def slides(*results: Result, limit: float = SLIP) -> Law:
    """Coulomb: no contact point's shear traction exceeds coefficient times pressure."""
    return at_most("|t| - mu p", _most(r.quality.slip_excess for r in results), limit)


def lets_go(result: Result) -> Law:
    """Zero force once the indenter has left: in the last frame."""
    force = np.linalg.norm(result.force, axis=1)
    return at_most("force after lift-off / largest", force[-1] / force.max(), 1e-6)


def same_force(says: str, first: Result, second: Result, limit: float) -> Law:
    """Equal forces in every frame, over the largest."""
    return at_most(says, difference(first.force, second.force), limit)


def same_end(says: str, first: Result, second: Result, limit: float) -> Law:
    """Equal forces in the last frame, however it was reached."""
    return at_most(says, difference(first.force[-1], second.force[-1]), limit)


def difference(first: ArrayLike, second: ArrayLike) -> float:
    """Largest difference over the largest size of the first; infinite for different shapes."""
    one, other = np.asarray(first, float), np.asarray(second, float)
    if one.shape != other.shape:
        return math.inf
    return float(np.abs(one - other).max() / max(float(np.abs(one).max()), 1e-30))


def mirrored(first: Result, second: Result, limit: float) -> Law:
    """The second is the first with x turned round: every displacement of the surface."""
    turned = second.surface[:, ::-1] * np.array([-1, 1, 1], np.float32)
    return at_most("mirror: |du| / |u|", difference(first.surface, turned), limit)


def swapped(first: Result, second: Result, limit: float) -> Law:
    """The second is the first with x and y exchanged: every displacement of the surface."""
    turned = second.surface.transpose(0, 2, 1, 3)[..., [1, 0, 2]]
    return at_most("x-y swap: |du| / |u|", difference(first.surface, turned), limit)


def smooth(says: str, values: Sequence[float] | Array, limit: float) -> Law:
    """No jump: the largest second difference over the largest value, at even steps."""
    curve = np.asarray(values, float)
    return at_most(says, np.abs(np.diff(curve, 2)).max() / np.abs(curve).max(), limit)


def rises(says: str, values: Sequence[float] | Array, least: float = 0.0) -> Law:
    """Each value is above the one before: smallest rise over the largest value."""
    curve = np.asarray(values, float)
    return at_least(says, np.diff(curve).min() / np.abs(curve).max(), least)


def push(result: Result) -> Array:
    """How hard the indenter pushes down, by frame (F,) [N]."""
    return -result.force[:, 2]


def _least(values: Iterable[Array]) -> float:
    return float(min(np.min(each) for each in values))


def _most(values: Iterable[Array]) -> float:
    return float(max(np.max(each) for each in values))
