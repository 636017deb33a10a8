"""Laws of mechanics that any press must obey: each is a measured number and its limit.

Where a law is used, its limit is stated with the reason: the accuracy expected of the mesh, the
tolerance or float32, and a factor of 2 to 5 above the measured value.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.errors import SimulationDiverged
from sim.result import Result

Array = NDArray[np.float64]

# Base reaction against contact force: the solver accepts a residual of the nodal forces of 1e-4 of
# the contact force (l2); summed over the nodes it may be a few times that.
BALANCE = 5e-4
# Contact lighter than this fraction of the press's largest is balanced to that fraction: the solver
# requests no more digits of a light touch than float32 has.
LIGHT = 0.01
# Shear traction above the friction limit, over the largest pressure: the last digits of float32.
SLIP = 1e-5
# Symmetry of displacements relative to the largest: float32 has 6e-8, and sums of some 1e5 terms
# with conjugate gradients that amplify their rounding lose two to three digits.
LAST_DIGITS = 2e-5
# Two paths to one elastic state, relative force: each is accepted with a residual of 1e-4.
SAME = 5e-4


@dataclass(frozen=True, slots=True)
class Law:
    """A law with its measured value and limit."""

    says: str
    measured: float
    sense: Literal["<=", ">="]
    limit: float

    @property
    def holds(self) -> bool:
        """True if the measured number is within its limit; False if it is not finite."""
        if not math.isfinite(self.measured):
            return False
        return self.measured <= self.limit if self.sense == "<=" else self.measured >= self.limit

    @property
    def used(self) -> float:
        """Part of the allowance that the measured number uses: 1 at the limit, 0 far from it."""
        over, under = self.measured, self.limit
        if self.sense == ">=" and self.limit > 0:
            over, under = under, over
        if under == 0 or not math.isfinite(self.measured):
            return 0.0 if self.holds else math.inf
        return max(0.0, over / under)

    def __str__(self) -> str:
        sense = "≤" if self.sense == "<=" else "≥"
        value = "no number, not" if math.isnan(self.measured) else f"{self.measured:.3g}"
        return f"{self.says}: {value} {sense} {self.limit:.3g}"


Laws = Iterable[Law]


def at_most(says: str, measured: float, limit: float) -> Law:
    """Return the law that a number is at most `limit`."""
    return Law(says, float(measured), "<=", limit)


def at_least(says: str, measured: float, limit: float) -> Law:
    """Return the law that a number is at least `limit`."""
    return Law(says, float(measured), ">=", limit)


def validity_laws(*results: Result, det_f: float = 0.1, pull: float = 1e-6) -> Laws:
    """Yield the laws of every press: no inverted element, forces in balance, no pull, and friction.

    `det_f` is the smallest determinant of the deformation gradient; the solver's own limit is 0.05.
    `pull` is the largest upward traction: zero, unless friction above 1 acts on a steep flank.
    Lifted to the undeformed surface, the indenter has left.
    """
    pulls, unbalanced = [], []
    for result in results:
        down = -result.traction[..., 2].astype(float)
        pulls.append(max(0.0, -down.min()) / max(float(np.abs(down).max()), 1e-30))
        force = np.linalg.norm(result.force, axis=1)
        fraction = force / max(float(force.max()) * LIGHT, 1e-30)
        unbalanced.append((result.quality.balance * np.minimum(1.0, fraction)).max())
    least = np.min([result.quality.det_f_min.min() for result in results])
    yield at_least("smallest det F", least, det_f)
    yield at_most("balance", np.max(unbalanced), BALANCE)
    yield at_most("tension / largest pressure", max(pulls), pull)
    beyond = [one.quality.slip_excess.max() for one in results if one.scene.effects.friction]
    if beyond:  # Coulomb: no point's shear traction exceeds coefficient times pressure
        yield at_most("|t| - mu p", np.max(beyond), SLIP)
    for result in results:
        if result.scene.motion.tip[-1][2] >= 0 and result.force.any():
            yield lets_go(result)


def conserves(result: Result, limit: float, says: str = "|work - stored energy| / work") -> Law:
    """Return the law that, if elastic and frictionless, the net work is stored in the end."""
    return at_most(says, abs(result.quality.energy_gap[-1]), limit)


def dissipates(result: Result, limit: float) -> Law:
    """Return the law of passivity: the work returned never exceeds the work done."""
    least = result.quality.energy_gap.min()
    return at_least("(work - stored energy) / work, least", least, -limit)


def lets_go(result: Result) -> Law:
    """Return the law of zero force in the last frame, after the indenter has left."""
    force = np.linalg.norm(result.force, axis=1)
    return at_most("force after lift-off / largest", force[-1] / force.max(), 1e-6)


def same_force(says: str, first: Result, second: Result) -> Law:
    """Return the law of equal forces in every frame, relative to the largest."""
    return at_most(says, difference(first.force, second.force), SAME)


def same_end(first: Result, second: Result, limit: float = SAME, says: str = "force") -> Law:
    """Return the law of equal forces in the last frame, on any path."""
    return at_most(says, difference(first.force[-1], second.force[-1]), limit)


def difference(first: ArrayLike, second: ArrayLike) -> float:
    """Return the largest difference over the largest value of the first; inf if shapes differ."""
    one, other = np.asarray(first, float), np.asarray(second, float)
    if one.shape != other.shape:
        return math.inf
    return float(np.abs(one - other).max() / max(float(np.abs(one).max()), 1e-30))


def alike(first: Result, second: Result) -> Law:
    """Return the law that no value differs in any bit."""
    pairs = [(getattr(first, n), getattr(second, n)) for n in ("wrench", "surface", "traction")]
    return at_most("values that differ", sum(int((a != b).sum()) for a, b in pairs), 0)


def mirrored(first: Result, second: Result, limit: float) -> Law:
    """Return the law that the surface of the second is that of the first, mirrored in x."""
    turned = second.surface[:, ::-1] * np.array([-1, 1, 1], np.float32)
    return at_most("mirror: |du| / |u|", difference(first.surface, turned), limit)


def swapped(first: Result, second: Result, limit: float) -> Law:
    """Return the law that the surface of the second is that of the first with x and y swapped."""
    turned = second.surface.transpose(0, 2, 1, 3)[..., [1, 0, 2]]
    return at_most("x-y swap: |du| / |u|", difference(first.surface, turned), limit)


def smooth(values: ArrayLike, limit: float) -> Law:
    """Return the law that a force at even steps has no jump."""
    curve = np.asarray(values, float)
    kink = np.abs(np.diff(curve, 2)).max() / np.abs(curve).max()
    return at_most("largest second difference / largest force", kink, limit)


def rises(says: str, values: ArrayLike, least: float = 0.0) -> Law:
    """Return the law that values increase: smallest increase over the largest value."""
    curve = np.asarray(values, float)
    return at_least(says, np.diff(curve).min() / np.abs(curve).max(), least)


def deeper(result: Result) -> Law:
    """Return the law that the push increases from frame to frame."""
    return rises("force rises with depth", push(result))


def straight(result: Result, limit: float) -> Law:
    """Return the law that the indenter pushes straight down."""
    aside = np.abs(result.force[:, :2]).max() / push(result).max()
    return at_most("force aside / force", aside, limit)


def push(result: Result) -> Array:
    """Return the downward push of the indenter by frame (F,) [N]."""
    return -result.force[:, 2]


def ends(results: Iterable[Result]) -> list[float]:
    """Return the push of each result in its last frame [N]."""
    return [float(push(result)[-1]) for result in results]


def evidence(diverged: SimulationDiverged) -> Laws:
    """Yield the laws of a rejection; the dump is read and removed.

    If the indenter passed through the skin, the waypoint is named and there is no other state.
    """
    if "passes through the skin" in str(diverged):
        yield at_least("names of the waypoint", str(diverged).count("waypoint"), 1)
        return
    numbers, missing = 0, 1
    if diverged.dump is not None:
        with np.load(diverged.dump) as dump:
            missing = len({"scene", "tip", "u", "nodes"} - set(dump.files))
            numbers = sum(int((~np.isfinite(dump[n])).sum()) for n in ("tip", "u", "nodes"))
        diverged.forget_dump()
    yield at_least("attempts listed", len(diverged.tried), 1)
    yield at_most("missing in the dump", missing, 0)
    yield at_most("numbers in the dump that are not finite", numbers, 0)
