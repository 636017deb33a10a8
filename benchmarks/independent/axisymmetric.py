"""Rigid axisymmetric indenter pressed into a round, bonded, neo-Hookean layer, with friction.

Contact at Gauss points of the top: pressure = multiplier + stiffness * penetration where that is
positive. Without friction the multiplier is updated at every reported depth until the force no
longer changes (augmented Lagrangian); the remaining penetration is reported. Friction uses
return mapping: the shear traction of the last step is increased by a spring and limited to
mu * pressure; the tangent is exact and not symmetric. All tractions are per undeformed area, which
changes neither forces nor Coulomb's ratio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from benchmarks.independent.element import Elastic, Grid, assembled, outer, quadratic
from benchmarks.independent.formulas import shear_and_bulk
from benchmarks.independent.profile import Profile

Array = NDArray[np.float64]

# Contact stiffness in modulus per contact radius, or per thickness where that is less.
STIFFNESS = 3000.0
# Gauss points along each element edge of the top.
POINTS = 4
# Residual over contact force at which Newton's method has converged, and its iteration limit.
CONVERGED, ITERATIONS = 1e-7, 20
# Maximum number of multiplier updates, and the change of force at which they end.
AUGMENTATIONS, STANDS_STILL = 4, 2e-5
# Minimum fraction of a Newton step, which is taken even if the merit function rises.
SHARE_MIN = 0.1
# Determinant of the deformation gradient below which a Newton step is shortened.
DET_MIN = 0.02
# Number of times a step may be halved before the press fails.
FAILURES = 40


class NotSolved(Exception):
    """Raised if Newton's method does not converge, even in small steps."""


@dataclass(frozen=True)
class Layer:
    """Soft body: a disc bonded at z = -thickness, free at its side and top."""

    radius: float
    """[m]."""
    thickness: float
    """[m]."""
    modulus: float = 0.145e6
    """Young's modulus [Pa]."""
    poisson: float = 0.45
    sliding: bool = False
    """True: the base may move sideways, so that a press by a plane is uniform."""


@dataclass(frozen=True)
class Answer:
    """Result at one depth."""

    depth: float
    """[m]."""
    force: float
    """Force along the axis [N]."""
    balance: float
    """|force + reaction of the base| over force."""
    det_f_min: float
    """Smallest determinant of the deformation gradient."""
    penetration: float
    """Mean penetration, weighted by pressure, over the depth."""


@dataclass
class RingState:
    """Displacements and contact state."""

    tip: float
    u: Array
    """(2 N,) [m]."""
    multiplier: Array
    """Multiplier, as a pressure (S, P) [Pa]."""
    shear: Array
    """Shear traction (S, P) of the last step [Pa]."""
    rate: Array
    """Derivative of `u` by the tip position in the last step, (2 N,)."""


class AxisymmetricPress:
    """One indenter on one layer with one mesh.

    The approximate contact radius [m] scales the contact stiffness; the density [kg/m^3] is for
    `in_time` only.
    """

    def __init__(
        self,
        layer: Layer,
        profile: Profile,
        grid: Grid,
        friction: float,
        contact_radius: float,
        density: float = 0.0,
    ) -> None:
        self.profile, self.friction = profile, friction
        shear, bulk = shear_and_bulk(layer.modulus, layer.poisson)
        self.elastic = Elastic(grid, shear, bulk)
        self.mass = self.elastic.mass(density)
        # Mass over the square of the time step [N/m], and where it would be without force.
        self.inertia, self.free_motion = 0.0 * self.mass, np.zeros(self.elastic.count)
        self.stiffness = STIFFNESS * layer.modulus / min(contact_radius, layer.thickness)
        self.nodes = grid.nodes
        top = grid.top
        place, weight = np.polynomial.legendre.leggauss(POINTS)
        self.shape, slope = quadratic(place)
        self.r, self.z = (self.nodes[top, axis] @ self.shape.T for axis in (0, 1))
        along = np.hypot(*(self.nodes[top, axis] @ slope.T for axis in (0, 1)))
        self.area = 2 * math.pi * self.r * weight * along
        self.unknowns = (2 * top[:, :, None] + np.arange(2)).reshape(len(top), 6)
        # Stresses are sums of terms as large as the bulk modulus, which sets the rounding error.
        self.rounding = 2e-14 * bulk * layer.radius * layer.thickness
        low = np.isclose(self.nodes[:, 1], -layer.thickness)
        held = np.zeros((len(self.nodes), 2), bool)
        held[low] = not layer.sliding, True
        held[np.isclose(self.nodes[:, 0], 0), 0] = True
        self.free = np.flatnonzero(~held.ravel())
        self.base = 2 * np.flatnonzero(low) + 1

    def run(self, depths: Sequence[float], path: Sequence[float]) -> list[Answer]:
        """Return results at `depths` on a `path` of depths [m]; NotSolved if a step has none."""
        none, still = np.zeros_like(self.r), np.zeros(2 * len(self.nodes))
        state, answers, before = RingState(0.0, still, none, none, still), [], 0.0
        for depth in sorted(depths):
            for middle in path:
                if 1.0001 * before < middle < 0.9999 * depth:
                    state = self._moved(state, -middle)
            state = self._moved(state, -depth)
            # The next step starts from the state before the multiplier updates, so adding a depth
            # changes no other result. With friction, the updates would alter stick and slip.
            settled = state if self.friction else self._settled(state)
            answers.append(self._answer(settled, depth))
            before = depth
        return answers

    def in_time(self, depths: Sequence[float], times: Sequence[float], steps: int) -> list[float]:
        """Return the force at each depth [m], reached at its time [s] (rising, above 0) [N].

        The tip starts from the top at time 0 and goes from depth to depth at constant speed, in
        about `steps` even steps in all, of backward Euler.

        Raises:
            NotSolved: A step does not converge.
        """
        none, still = np.zeros_like(self.r), np.zeros(self.elastic.count)
        state, speed, forces = RingState(0.0, still, none, none, still), still, list[float]()
        before = 0.0
        for depth, time in zip(depths, times, strict=True):
            count = max(1, round(steps * (time - before) / times[-1]))
            step, top = (time - before) / count, state.tip
            for number in range(1, count + 1):
                tip = top + (-depth - top) * number / count
                state, speed = self._swung(state, speed, tip, step)
            forces.append(self._tractions(state, state.u, state.tip).force)
            before = time
        return forces

    def _swung(
        self, state: RingState, speed: Array, tip: float, step: float, halvings: int = 8
    ) -> tuple[RingState, Array]:
        """Return the state and its speed after a time `step` [s], halved where needed."""
        self.inertia, self.free_motion = self.mass / step**2, state.u + step * speed
        after = self._balanced(state, tip)
        if after is not None:
            return after, (after.u - state.u) / step
        if not halvings:
            raise NotSolved(f"at a depth of {-state.tip * 1e3:.4g} mm")
        middle = (state.tip + tip) / 2
        state, speed = self._swung(state, speed, middle, step / 2, halvings - 1)
        return self._swung(state, speed, tip, step / 2, halvings - 1)

    def _moved(self, state: RingState, target: float) -> RingState:
        """Apply Newton's method to a tip at z = `target`, in smaller steps where needed."""
        step, failed = target - state.tip, 0
        while state.tip != target:
            last = abs(target - state.tip) <= 1.001 * abs(step)
            balanced = self._balanced(state, target if last else state.tip + step)
            if balanced is None:
                failed, step = failed + 1, step / 2
                if failed > FAILURES:
                    raise NotSolved(f"at a depth of {-state.tip * 1e3:.4g} mm")
            else:
                state, step = balanced, 2 * step
        return state

    def _settled(self, state: RingState) -> RingState:
        """Return the state with updated multipliers, as far as Newton's method converges."""
        contact, fraction = self._tractions(state, state.u, state.tip), 1.0
        for _ in range(AUGMENTATIONS):
            multiplier = state.multiplier + fraction * (contact.pressure - state.multiplier)
            balanced = self._balanced(replace(state, multiplier=multiplier), state.tip)
            if balanced is None:
                fraction /= 2
                continue
            before, state = contact.force, balanced
            contact = self._tractions(state, state.u, state.tip)
            if abs(contact.force - before) < STANDS_STILL * fraction * abs(contact.force):
                break
        return state

    def _balanced(self, old: RingState, tip: float) -> RingState | None:
        """Return the equilibrium with the tip at `tip`, or None if Newton's method fails."""
        u = old.u + old.rate * (tip - old.tip)
        if self._inverted(u):
            u = old.u.copy()
        contact, residual, merit = self._residual(old, u, tip)
        for _ in range(ITERATIONS):
            accelerated = self.inertia @ (u - self.free_motion)
            size = float(np.linalg.norm(contact.nodal) + np.linalg.norm(accelerated))
            if np.linalg.norm(residual) < max(CONVERGED * size, self.rounding):
                travel = tip - old.tip
                rate = (u - old.u) / travel if travel else old.rate
                return RingState(tip, u, old.multiplier, contact.shear, rate)
            tangent = self.elastic.tangent(u) + self.inertia
            matrix = (tangent + self._tangent(contact))[self.free][:, self.free]
            factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
            change = np.zeros_like(u)
            change[self.free] = factors.solve(residual)
            fraction = 1.0
            while True:
                if not self._inverted(u - fraction * change):
                    contact, residual, now = self._residual(old, u - fraction * change, tip)
                    # Near convergence, changes of the merit function are rounding errors.
                    if now < merit + 1e-9 * abs(merit) or fraction < SHARE_MIN:
                        break
                fraction /= 2
                if fraction < SHARE_MIN / 16:
                    return None
            merit = now
            u -= fraction * change
        return None

    def _residual(self, old: RingState, u: Array, tip: float) -> tuple[Contact, Array, float]:
        """Return the contact, the residual, and the merit function of a Newton step.

        The merit function is the potential energy, which is minimal in equilibrium, if there is no
        friction, and the norm of the residual otherwise.
        """
        contact = self._tractions(old, u, tip)
        pushed = np.bincount(self.unknowns.ravel(), contact.nodal.ravel(), len(u))
        away = u - self.free_motion
        accelerated = self.inertia @ away
        residual: Array = (self.elastic.force(u) + accelerated - pushed)[self.free]
        if self.friction:
            return contact, residual, float(np.linalg.norm(residual))
        stored = float(np.sum(contact.pressure**2 * self.area)) / (2 * self.stiffness)
        stored += float(away @ accelerated) / 2
        return contact, residual, self.elastic.energy(u) + stored

    def _inverted(self, u: Array) -> bool:
        _, j, theta = self.elastic.strain(u)
        return bool(min(j.min(), theta.min()) < DET_MIN)

    def _tractions(self, old: RingState, u: Array, tip: float) -> Contact:
        """Return the tractions of the indenter on the top, and their derivative."""
        moved = u[self.unknowns].reshape(-1, 3, 2)
        place = self.shape @ moved
        r, z = self.r + place[..., 0], self.z + place[..., 1] - tip
        gap, normal_r, normal_z, bend = self.profile.distance(r, z)
        pressure = np.maximum(old.multiplier - self.stiffness * gap, 0.0)
        touching = pressure > 0
        normal = np.stack([normal_r, normal_z], axis=-1)
        tangent = np.stack([normal_z, -normal_r], axis=-1)
        across = outer(tangent, tangent)
        stiff = self.stiffness * outer(normal, normal)
        stiff = stiff - (pressure * bend)[..., None, None] * across
        traction = pressure[..., None] * normal
        shear = np.zeros_like(pressure)
        if self.friction:
            before = old.u[self.unknowns].reshape(-1, 3, 2)
            slip = self.shape @ (moved - before) - np.array([0.0, tip - old.tip])
            along = np.sum(slip * tangent, axis=-1)
            fraction, rise = self._touched(old, before, gap)
            trial = old.shear - self.stiffness * fraction * along
            limit = self.friction * pressure
            slips = np.abs(trial) > limit
            shear = np.where(slips, np.sign(trial) * limit, trial) * touching
            # d(tangent) = -bend (tangent . dx) normal, d(pressure) = -stiffness normal . dx
            off = np.sum(slip * normal, axis=-1)
            mixed = outer(tangent, normal)
            sticking = (fraction * (1 - off * bend))[..., None, None] * across
            sticking = -self.stiffness * (sticking + (along * rise)[..., None, None] * mixed)
            sliding = (-self.friction * self.stiffness * np.sign(trial))[..., None, None] * mixed
            change = np.where(slips[..., None, None], sliding, sticking)
            stiff = stiff - change + (shear * bend)[..., None, None] * outer(normal, tangent)
            traction = traction + shear[..., None] * tangent
        stiff = touching[..., None, None] * stiff
        weighted = traction * self.area[..., None]
        nodal = np.einsum("pn,spc->snc", self.shape, weighted).reshape(-1, 6)
        force = -float(weighted[..., 1].sum())
        return Contact(pressure, shear, nodal, stiff, force)

    def _touched(self, old: RingState, before: Array, gap: Array) -> tuple[Array, Array]:
        """Return the fraction of the step in contact (S, P), and its derivative by the gap [1/m].

        Without it, friction is exact only to first order in the step: a point that has just come
        into contact would be dragged by the whole step.
        """
        moved = self.shape @ before
        was = self.profile.distance(self.r + moved[..., 0], self.z + moved[..., 1] - old.tip)[0]
        came = (was > 0) & (gap < 0)
        closed = np.where(came, gap - was, -1.0)
        return np.where(came, gap / closed, 1.0), np.where(came, -was / closed**2, 0.0)

    def _tangent(self, contact: Contact) -> csc_matrix:
        local = np.einsum(
            "pn,spcd,sp,pm->sncmd", self.shape, contact.stiff, self.area, self.shape, optimize=True
        )
        return assembled(local, self.unknowns, 2 * len(self.nodes))

    def _answer(self, state: RingState, depth: float) -> Answer:
        contact = self._tractions(state, state.u, state.tip)
        force = self.elastic.force(state.u)
        load = contact.pressure * self.area
        touching = max(float(load.sum()), np.finfo(float).tiny)
        balance = abs(contact.force - float(force[self.base].sum())) / touching
        left = np.maximum(contact.pressure - state.multiplier, 0.0) / self.stiffness
        penetration = float(np.sum(load * left)) / touching / depth
        det = float(self.elastic.strain(state.u)[1].min())
        return Answer(depth, contact.force, balance, det, penetration)


@dataclass(frozen=True)
class Contact:
    """Tractions at the contact points of the top."""

    pressure: Array
    """(S, P) [Pa]."""
    shear: Array
    """(S, P) along the tangent (n_z, -n_r) [Pa]."""
    nodal: Array
    """Nodal forces (S, 6) of each edge [N]."""
    stiff: Array
    """-d(traction)/d(place) at the points, (S, P, 2, 2) [Pa/m]."""
    force: float
    """Downward force of the indenter [N]."""
