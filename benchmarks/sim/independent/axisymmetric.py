"""A round rigid indenter pressed straight into a round, bonded, neo-Hookean layer, with friction.

Contact at Gauss points of the top: pressure = carried + stiffness * penetration where that is
positive, `carried` brought up to date at every depth that is reported until the force stands still
(augmented Lagrangian) where there is no friction; the penetration that is left is told. Friction
by return mapping: the shear traction of the last step moves on by a spring and is cut back to
mu * pressure; the tangent is the true derivative, not symmetric. All tractions are per untouched
area, which does not change what they are: forces and Coulomb's ratio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from benchmarks.sim.independent.element import Elastic, Grid, quadratic
from benchmarks.sim.independent.profile import Profile

Array = NDArray[np.float64]
Base = Literal["bonded", "sliding"]

# Contact stiffness in modulus per contact radius, or per thickness where that is less.
STIFFNESS = 3000.0
# Gauss points along each element edge of the top.
POINTS = 4
# Out-of-balance force over contact force that ends Newton's method, and its limit.
CONVERGED, ITERATIONS = 1e-7, 20
# How often `carried` is brought up to date at most, and the change of force that ends it.
AUGMENTATIONS, STANDS_STILL = 4, 2e-5
# Part of a Newton step that is made whatever comes of it.
SHARE_MIN = 0.1
# Determinant of the deformation gradient below which a Newton step is cut.
DET_MIN = 0.02
# How often a step may be cut in half before the press is given up.
FAILURES = 40


class NotSolved(Exception):
    """Newton's method found no balance, even in small steps."""


@dataclass(frozen=True)
class Layer:
    """The soft body: a disc bonded at z = -thickness, free at its side and top."""

    radius: float
    """[m]."""
    thickness: float
    """[m]."""
    modulus: float = 0.145e6
    """Young's modulus [Pa]."""
    poisson: float = 0.45
    base: Base = "bonded"
    """`sliding` lets the base move sideways, which makes a plane's press uniform."""

    @property
    def shear(self) -> float:
        """G [Pa]."""
        return self.modulus / (2 * (1 + self.poisson))

    @property
    def bulk(self) -> float:
        """K [Pa]."""
        return self.modulus / (3 * (1 - 2 * self.poisson))


@dataclass(frozen=True)
class Answer:
    """What the indenter feels at one depth."""

    depth: float
    """[m]."""
    force: float
    """Along the axis [N]."""
    contact_radius: float
    """Largest radius that touches, where it is now [m]."""
    balance: float
    """|force + reaction of the base| over force."""
    det_f_min: float
    """Smallest determinant of the deformation gradient."""
    penetration: float
    """How deep the indenter is in the layer, weighted by pressure, over the depth."""


@dataclass
class State:
    """Displacements, and what the contact points carry."""

    tip: float
    u: Array
    """(2 N,) [m]."""
    carried: Array
    """Pressure (S, P) that the augmentation holds [Pa]."""
    shear: Array
    """Shear traction (S, P) of the last step [Pa]."""
    rate: Array
    """How `u` moved with the tip in the last step, (2 N,)."""


class Press:
    """One layer on one grid under one indenter.

    Args:
        layer: The soft body.
        profile: The indenter.
        grid: The mesh of the layer.
        friction: Coulomb's coefficient.
        contact_radius: About how wide the contact will be [m]; scales the contact stiffness.
    """

    def __init__(
        self, layer: Layer, profile: Profile, grid: Grid, friction: float, contact_radius: float
    ) -> None:
        self.layer, self.profile, self.grid, self.friction = layer, profile, grid, friction
        self.elastic = Elastic(grid, layer.shear, layer.bulk)
        self.stiffness = STIFFNESS * layer.modulus / min(contact_radius, layer.thickness)
        self.nodes = grid.nodes
        top = grid.top
        place, weight = np.polynomial.legendre.leggauss(POINTS)
        self.shape, slope = quadratic(place)
        self.r, self.z = (self.nodes[top, axis] @ self.shape.T for axis in (0, 1))
        along = np.hypot(*(self.nodes[top, axis] @ slope.T for axis in (0, 1)))
        self.area = 2 * math.pi * self.r * weight * along
        self.unknowns = (2 * top[:, :, None] + np.arange(2)).reshape(len(top), 6)
        # Stresses are sums of terms as large as the bulk modulus.
        self.rounding = 2e-14 * layer.bulk * layer.radius * layer.thickness
        fixed = np.isclose(self.nodes[:, 0], 0)
        low = np.isclose(self.nodes[:, 1], -layer.thickness)
        held = np.zeros((len(self.nodes), 2), bool)
        held[fixed, 0] = True
        held[low, 1] = True
        if layer.base == "bonded":
            held[low, 0] = True
        self.free = np.flatnonzero(~held.ravel())
        self.base = 2 * np.flatnonzero(low) + 1

    def start(self) -> State:
        """The untouched layer, the tip on its top."""
        none, still = np.zeros_like(self.r), np.zeros(2 * len(self.nodes))
        return State(0.0, still, none, none, still)

    def run(self, depths: Sequence[float], path: Sequence[float]) -> list[Answer]:
        """Answers at `depths` [m], by way of the depths of `path` [m] in between.

        Raises:
            NotSolved: A step that cannot be balanced.
        """
        state, answers, before = self.start(), [], 0.0
        for depth in sorted(depths):
            for middle in path:
                if 1.0001 * before < middle < 0.9999 * depth:
                    state = self._moved(state, -middle)
            state = self._moved(state, -depth)
            # The way on goes from the state before it is settled, so that one depth more or less
            # asked for changes nothing. Stick and slip would change places while it is settled.
            found = state if self.friction else self._settled(state)
            answers.append(self._answer(found, depth))
            before = depth
        return answers

    def _moved(self, state: State, target: float) -> State:
        """Newton's method from `state` to a tip at z = `target`, in smaller steps where need be."""
        step, failed = target - state.tip, 0
        while state.tip != target:
            last = abs(target - state.tip) <= 1.001 * abs(step)
            found = self._balanced(state, target if last else state.tip + step)
            if found is None:
                failed, step = failed + 1, step / 2
                if failed > FAILURES:
                    raise NotSolved(f"at a depth of {-state.tip * 1e3:.4g} mm")
            else:
                state, step = found, 2 * step
        return state

    def _settled(self, state: State) -> State:
        """The state with its pressure carried, as far as Newton's method gets with that."""
        force, share = self._tractions(state, state.u, state.tip).force, 1.0
        for _ in range(AUGMENTATIONS):
            pressure = self._tractions(state, state.u, state.tip).pressure
            carried = state.carried + share * (pressure - state.carried)
            found = self._balanced(replace(state, carried=carried), state.tip)
            if found is None:
                share /= 2
                continue
            before, force = force, self._tractions(found, found.u, found.tip).force
            state = found
            if abs(force - before) < STANDS_STILL * share * abs(force):
                break
        return state

    def _balanced(self, old: State, tip: float) -> State | None:
        """The state with the tip at `tip` that balances; None where Newton's method finds none."""
        u = old.u + old.rate * (tip - old.tip)
        if self._inverted(u):
            u = old.u.copy()
        contact, residual, merit = self._residual(old, u, tip)
        for _ in range(ITERATIONS):
            size = float(np.linalg.norm(contact.nodal))
            if np.linalg.norm(residual) < max(CONVERGED * size, self.rounding):
                travel = tip - old.tip
                rate = (u - old.u) / travel if travel else old.rate
                return State(tip, u, old.carried, contact.shear, rate)
            tangent = self.elastic.tangent(u)
            matrix = (tangent + self._tangent(contact))[self.free][:, self.free]
            factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
            change = np.zeros_like(u)
            change[self.free] = factors.solve(residual)
            share = 1.0
            while True:
                if not self._inverted(u - share * change):
                    contact, residual, now = self._residual(old, u - share * change, tip)
                    # Nearly there, merit is rounding.
                    if now < merit + 1e-9 * abs(merit) or share < SHARE_MIN:
                        break
                share /= 2
                if share < SHARE_MIN / 16:
                    return None
            merit = now
            u -= share * change
        return None

    def _residual(self, old: State, u: Array, tip: float) -> tuple[Contact, Array, float]:
        """Contact, forces that are out of balance, and what a Newton step must not raise.

        That is the potential energy, which balance makes least, where there is no friction; else
        the forces that are out of balance.
        """
        contact = self._tractions(old, u, tip)
        pushed = np.bincount(self.unknowns.ravel(), contact.nodal.ravel(), len(u))
        residual: Array = (self.elastic.force(u) - pushed)[self.free]
        if self.friction:
            return contact, residual, float(np.linalg.norm(residual))
        stored = float(np.sum(contact.pressure**2 * self.area)) / (2 * self.stiffness)
        return contact, residual, self.elastic.energy(u) + stored

    def _inverted(self, u: Array) -> bool:
        return bool(min(values.min() for values in self.elastic.dilatation(u)) < DET_MIN)

    def _tractions(self, old: State, u: Array, tip: float) -> Contact:
        """What the indenter does to the top, and how that changes with displacement."""
        moved = u[self.unknowns].reshape(-1, 3, 2)
        place = self.shape @ moved
        r, z = self.r + place[..., 0], self.z + place[..., 1] - tip
        gap, normal_r, normal_z, bend = self.profile.distance(r, z)
        pressure = np.maximum(old.carried - self.stiffness * gap, 0.0)
        touching = pressure > 0
        normal = np.stack([normal_r, normal_z], axis=-1)
        tangent = np.stack([normal_z, -normal_r], axis=-1)
        outer = normal[..., :, None] * normal[..., None, :]
        across = tangent[..., :, None] * tangent[..., None, :]
        stiff = touching[..., None, None] * (
            self.stiffness * outer - (pressure * bend)[..., None, None] * across
        )
        traction = pressure[..., None] * normal
        shear = np.zeros_like(pressure)
        if self.friction:
            before = old.u[self.unknowns].reshape(-1, 3, 2)
            slip = self.shape @ (moved - before) - np.array([0.0, tip - old.tip])
            along = np.sum(slip * tangent, axis=-1)
            share, rise = self._touched(old, before, gap)
            trial = old.shear - self.stiffness * share * along
            limit = self.friction * pressure
            slips = np.abs(trial) > limit
            shear = np.where(slips, np.sign(trial) * limit, trial) * touching
            # d(tangent) = -bend (tangent . dx) normal, d(pressure) = -stiffness normal . dx
            off = np.sum(slip * normal, axis=-1)
            mixed = tangent[..., :, None] * normal[..., None, :]
            sticking = (share * (1 - off * bend))[..., None, None] * across
            sticking = -self.stiffness * (sticking + (along * rise)[..., None, None] * mixed)
            sliding = (-self.friction * self.stiffness * np.sign(trial))[..., None, None] * mixed
            change = np.where(slips[..., None, None], sliding, sticking)
            turned = (shear * bend)[..., None, None] * (
                normal[..., :, None] * tangent[..., None, :]
            )
            stiff = stiff - touching[..., None, None] * (change - turned)
            traction = traction + shear[..., None] * tangent
        weighted = traction * self.area[..., None]
        nodal = np.einsum("pn,spc->snc", self.shape, weighted).reshape(-1, 6)
        force = -float(weighted[..., 1].sum())
        reach = float((r * touching).max(initial=0.0))
        return Contact(pressure, shear, nodal, stiff, force, reach)

    def _touched(self, old: State, before: Array, gap: Array) -> tuple[Array, Array]:
        """Share of the step in which a point touches (S, P), and its derivative by the gap [1/m].

        Without it friction is exact to first order in the step only: a point that has just been
        reached would be dragged by all of the step.
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
        rows = np.repeat(self.unknowns, 6, axis=1).ravel()
        columns = np.tile(self.unknowns, (1, 6)).ravel()
        count = 2 * len(self.nodes)
        return csc_matrix((local.ravel(), (rows, columns)), shape=(count, count))

    def _answer(self, state: State, depth: float) -> Answer:
        contact = self._tractions(state, state.u, state.tip)
        force = self.elastic.force(state.u)
        balance = abs(contact.force - float(force[self.base].sum())) / contact.force
        j, _ = self.elastic.dilatation(state.u)
        load = contact.pressure * self.area
        left = np.maximum(contact.pressure - state.carried, 0.0) / self.stiffness
        penetration = float(np.sum(load * left) / np.sum(load)) / depth
        det = float(j.min())
        return Answer(depth, contact.force, contact.reach, balance, det, penetration)


@dataclass(frozen=True)
class Contact:
    """Tractions on the contact points of the top."""

    pressure: Array
    """(S, P) [Pa]."""
    shear: Array
    """(S, P) along the tangent (n_z, -n_r) [Pa]."""
    nodal: Array
    """Force (S, 6) on the nodes of each edge [N]."""
    stiff: Array
    """-d(traction)/d(place) at the points, (S, P, 2, 2) [Pa/m]."""
    force: float
    """Of the indenter, downwards [N]."""
    reach: float
    """Largest r that touches [m]."""
