# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""Newton's method on a batch: tangent solved inexactly, steps accepted by the slope along them.

The slope test (directional derivative) keeps its digits where a difference of energies drowns in
round-off. With friction the limit follows the pressure from iteration to iteration, so that what
converges is the coupled state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from sim.fem.assembly import Assembly
from sim.fem.cg import ConjugateGradient
from sim.fem.scalars import numpy_of
from sim.fem.vectors import copy_active, walk

FORCE_FLOOR = {"float32": 1e-3, "float64": 1e-5}
"""Smallest force that residuals are measured against [E T^2]: 2 mN in the paper's gel in float32,
so that a tolerance of 1e-4 asks for no more than 0.2 uN, about what its digits can give."""
DET_TRIAL = 0.02
"""No trial state may be compressed further than this anywhere."""
TRIALS = 12
"""Step lengths tried along one direction."""

LENGTH_GOOD = 0.2
"""Below this share of a full step, or where the tangent is not convex, the next is damped."""
DAMPING_LEAST, DAMPING_MOST = 2.0, 1e5
"""Stiffness against any motion that is added then [E / T^2], least and most: from that of the
softest to that of the stiffest motion of the body. It shrinks by 4 with every good step."""
RELAX_AFTER, RELAX_SHARE = 4, 0.5
"""Friction's limit follows the pressure at once for the first iterations, later half of the way:
the two may answer each other with equal and opposite changes for ever."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What Newton's method reached, by environment (B,)."""

    converged: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    cg: np.ndarray


class Newton:
    """The nonlinear solver of one assembly; owns its work space."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        nodes = len(assembly.mesh.nodes)
        self._cg = ConjugateGradient(
            assembly.real, assembly.environments, nodes, str(assembly.device)
        )
        self._start = wp.zeros_like(assembly.state.u)

    def solve(self, chosen: np.ndarray) -> Outcome:
        """Bring the chosen environments (B,) bool into balance, from `state.u` on."""
        assembly, state, numerics = self._assembly, self._assembly.state, self._assembly.numerics
        count = assembly.environments
        iterations, cg = np.zeros(count, int), np.zeros(count, int)
        converged, residual = np.zeros(count, bool), np.full(count, np.inf)
        damping = np.zeros(count)
        rubbing = "friction" in assembly.effects and not numerics.planted.lagged_friction
        running = chosen.copy()
        active = self._mask(running)
        if "friction" in assembly.effects and numerics.planted.lagged_friction:
            state.settle_limit(active)
        sums = assembly.evaluate(active, state.u, self._cg.solution)
        for iteration in range(numerics.newton_max + 1):
            if rubbing:
                state.settle_limit(active)
                sums = assembly.evaluate_contact(active, state.u, self._cg.solution)
            force = np.maximum(np.sqrt(sums[:, 1]), FORCE_FLOOR[assembly.precision])
            residual[running] = (np.sqrt(sums[:, 0]) / force)[running]
            sound = np.isfinite(residual) & (assembly.det_min() > DET_TRIAL)
            reached = running & sound & (residual <= numerics.tolerance)
            converged |= reached
            running &= sound & ~reached
            if not running.any() or iteration == numerics.newton_max:
                break
            active = self._mask(running)
            if rubbing:
                share = 1.0 if iteration < RELAX_AFTER else RELAX_SHARE
                state.relax_limit(active, share)
                if share < 1.0:
                    assembly.evaluate_contact(active, state.u, self._cg.solution)
            assembly.linearise(active, damping)
            accuracy = np.clip(0.3 * residual, 1e-3, 1e-2)
            accuracy = np.where(running, accuracy, 1.0)
            used = self._cg.solve(
                active,
                assembly.residual,
                assembly.jacobi,
                assembly.tangent(state.u),
                accuracy,
                numerics.cg_max,
            )
            cg[running] += used[running]
            iterations[running] += 1
            walked, length, sums = self._search(active, running)
            hard = self._cg.concave() | (length < LENGTH_GOOD) | ~walked
            damping = np.where(hard, np.clip(damping * 8, DAMPING_LEAST, DAMPING_MOST), damping / 4)
            damping[damping < DAMPING_LEAST] = 0.0
            running &= walked | (damping < DAMPING_MOST)
            active = self._mask(running)
        converged &= assembly.det_min() > numerics.det_floor
        return Outcome(converged, residual, iterations, cg)

    def _search(self, active, running: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Walk along the direction; who found a step (B,), how long (B,), the sums there."""
        assembly, state = self._assembly, self._assembly.state
        by_energy = assembly.numerics.planted.energy_line_search
        direction = self._cg.solution
        copy_active(active, state.u, self._start)
        energy = assembly.energy() if by_energy else None
        slope = -self._dot(direction)
        length = np.ones(assembly.environments)
        open_, sums = running.copy(), np.zeros((assembly.environments, 3))
        for _trial in range(TRIALS):
            trying = self._mask(open_)
            lengths = wp.array(
                length.astype(numpy_of(assembly.real)), dtype=assembly.real, device=assembly.device
            )
            walk(trying, lengths, self._start, direction, state.u)
            new = assembly.evaluate(trying, state.u, direction)
            sums[open_] = new[open_]
            with np.errstate(invalid="ignore", divide="ignore"):
                sound = np.isfinite(new).all(axis=1) & (assembly.det_min() > DET_TRIAL)
                good = sound & (new[:, 2] <= 0.5 * np.abs(slope))
                if by_energy:
                    good = sound & (assembly.energy() <= energy + 1e-4 * length * slope)
                shrink = np.where(sound, slope / (slope - new[:, 2]), 0.5)
            open_ &= ~good
            if not open_.any():
                break
            shrink = np.clip(np.nan_to_num(shrink, nan=0.5), 0.1, 0.7)
            length[open_] *= shrink[open_]
        if open_.any():
            stuck = self._mask(open_)
            copy_active(stuck, self._start, state.u)
            sums[open_] = assembly.evaluate(stuck, state.u, direction)[open_]
        return running & ~open_, length, sums

    def _dot(self, direction) -> np.ndarray:
        """Product of residual and direction by environment (B,)."""
        residual = self._assembly.residual.numpy()
        return np.einsum("bni,bni->b", residual, direction.numpy(), dtype=float)

    def _mask(self, chosen: np.ndarray):
        return wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self._assembly.device)
