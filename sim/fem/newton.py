# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""Newton's method on a batch in which every environment is at its own iteration of its own step.

Tangent solved inexactly, steps accepted by the slope along them: the directional derivative keeps
its digits where a difference of energies drowns in round-off. With friction the limit follows the
pressure from iteration to iteration, so that what converges is the coupled state.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from sim.fem.assembly import Assembly
from sim.fem.cg import ConjugateGradient
from sim.fem.numerics import ELASTIC_EVERY
from sim.fem.scalars import numpy_of
from sim.fem.vectors import copy_active, walk

FORCE_FLOOR = {"float32": 1e-3, "float64": 1e-5}
"""Smallest force that residuals are measured against [E T^2]: 2 mN in the paper's gel in float32,
so that a tolerance of 1e-4 asks for no more than 0.2 uN, about what its digits can give."""
DET_TRIAL = 0.02
"""No trial state may be compressed further than this anywhere."""
TRIALS = 12
"""Step lengths tried along one direction."""

ACCURACY, ACCURACY_LEAST = 0.1, 3e-3
"""Accuracy of a linear solve, largest and least; 0.3 of the residual over the force between. Finer
solves cost more iterations of the linear solver than they save of Newton's."""
LENGTH_GOOD = 0.2
"""Below this share of a full step, or where the tangent is not convex, the next is damped."""
DAMPING_LEAST, DAMPING_MOST = 2.0, 1e5
"""Stiffness against any motion that is added then [E / T^2], least and most: from that of the
softest to that of the stiffest motion of the body. It shrinks by 4 with every good step."""
RELAX_AFTER, RELAX_SHARE = 4, 0.5
"""Friction's limit follows the pressure at once for the first iterations, later half of the way:
the two may answer each other with equal and opposite changes for ever."""


class Newton:
    """The nonlinear solver of one assembly; owns its work space, and counts by environment (B,)."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        count, nodes = assembly.environments, len(assembly.mesh.nodes)
        self._cg = ConjugateGradient(
            assembly.real, count, nodes, str(assembly.device), assembly.stencil, assembly.columns
        )
        self._start = wp.zeros_like(assembly.state.u)
        planted = assembly.numerics.planted
        self._friction = "friction" in assembly.effects
        self._rubbing = self._friction and not planted.lagged_friction
        self.residual = np.full(count, np.inf)
        """Out-of-balance force over force of the present state."""
        self.iterations = np.zeros(count, int)
        """Newton iterations since `begin`."""
        self.cg = np.zeros(count, int)
        """Conjugate-gradient iterations since `begin`."""
        self.converged = np.zeros(count, bool)
        """Whether the present state is in balance."""
        self.failed = np.zeros(count, bool)
        """Whether there is no way on from the present state."""
        self._predicting = np.zeros(count, bool)
        self._tolerance = np.full(count, assembly.numerics.tolerance)
        self._damping = np.zeros(count)

    def begin(self, chosen: np.ndarray, tolerance: np.ndarray, *, predict: np.ndarray) -> None:
        """Start on a step of the chosen environments, from `state.u` on; all (B,).

        Where `predict` is set, `state.u` is the state before the tip moved: the first iteration
        follows the tip along the tangent there, with the contact that there was.
        """
        if not chosen.any():
            return
        self._tolerance[chosen] = tolerance[chosen]
        self._predicting[chosen] = predict[chosen]
        state = self._assembly.state
        if self._friction:
            state.settle_limit(self.mask(chosen))
        state.put_tip(chosen & predict, before=True)
        state.put_tip(chosen & ~predict)
        self.resume(chosen)

    def resume(self, chosen: np.ndarray) -> None:
        """Go on from the present state, with equations that have changed since it was found."""
        if not chosen.any():
            return
        self.iterations[chosen], self.cg[chosen] = 0, 0
        self.residual[chosen], self._damping[chosen] = np.inf, 0.0
        self.converged[chosen], self.failed[chosen] = False, False
        state = self._assembly.state
        self._assembly.evaluate(self.mask(chosen), state.u, self._cg.solution)
        self._judge(chosen & ~self._predicting)

    def sweep(self, running: np.ndarray) -> None:
        """One iteration of every running environment (B,) that is neither converged nor failed."""
        assembly, state = self._assembly, self._assembly.state
        active, predicting = self.mask(running), running & self._predicting
        if self._rubbing:
            late = running & (self.iterations >= RELAX_AFTER)
            state.relax_limit(self.mask(running & ~late), 1.0)
            if late.any():
                slow = self.mask(late)
                state.relax_limit(slow, RELAX_SHARE)
                assembly.evaluate_contact(slow, state.u, self._cg.solution)
        anew = None
        if assembly.stencil.keeps:
            due = (self.iterations % ELASTIC_EVERY == 0) | (self._damping > 0)
            anew = self.mask(running & due)
        assembly.linearise(active, state.u, self._damping, anew)
        if predicting.any():
            assembly.push(self.mask(predicting), state.travel(predicting))
        accuracy = np.clip(0.3 * self.residual, ACCURACY_LEAST, ACCURACY)
        used = self._cg.solve(
            active,
            assembly.residual,
            np.where(running, accuracy, 1.0),
            assembly.numerics.cg_max,
        )
        self.cg[running] += used[running]
        self.iterations[running] += 1
        slope, concave = self._cg.verdict()
        state.put_tip(predicting)
        walked, length = self._search(active, running, predicting, slope)
        self._predicting[running] = False
        hard = ~predicting & (concave | (length < LENGTH_GOOD) | ~walked)
        stiffer = np.clip(self._damping * 8, DAMPING_LEAST, DAMPING_MOST)
        damping = np.where(hard, stiffer, self._damping / 4)
        damping[damping < DAMPING_LEAST] = 0.0
        self._damping[running] = damping[running]
        self._judge(running)
        spent = self.iterations >= assembly.numerics.newton_max
        stuck = ~walked & (damping >= DAMPING_MOST)
        self.failed |= running & ~self.converged & (spent | stuck)

    def _judge(self, chosen: np.ndarray) -> None:
        """Find out which of the chosen are in balance, and which are beyond repair."""
        if not chosen.any():
            return
        assembly, state = self._assembly, self._assembly.state
        if self._rubbing:
            active = self.mask(chosen)
            state.settle_limit(active)
            assembly.evaluate_contact(active, state.u, self._cg.solution)
        sums = assembly.sums
        force = np.maximum(np.sqrt(sums.applied), FORCE_FLOOR[assembly.precision])
        self.residual[chosen] = (np.sqrt(sums.square) / force)[chosen]
        sound = np.isfinite(self.residual) & (sums.det > DET_TRIAL)
        balanced = chosen & sound & (self.residual <= self._tolerance)
        good = sums.det > assembly.numerics.det_floor
        self.converged |= balanced & good
        self.failed |= (chosen & ~sound) | (balanced & ~good)

    def _search(self, active, running, predicting, slope) -> tuple[np.ndarray, np.ndarray]:
        """Walk along the direction; who found a step (B,), and how long (B,).

        A prediction is taken whole, or not at all where it leads to a state that cannot be.
        """
        assembly, state = self._assembly, self._assembly.state
        by_energy = assembly.numerics.planted.energy_line_search
        direction = self._cg.solution
        copy_active(active, state.u, self._start)
        energy = assembly.energy() if by_energy else None
        length = np.ones(assembly.environments)
        open_ = running.copy()
        for _trial in range(TRIALS):
            trying = self.mask(open_)
            self._walk(trying, length)
            sums = assembly.evaluate(trying, state.u, direction)
            with np.errstate(invalid="ignore", divide="ignore"):
                sound = np.isfinite(sums.square) & np.isfinite(sums.slope) & (sums.det > DET_TRIAL)
                good = sound & (sums.slope <= 0.5 * np.abs(slope))
                if by_energy:
                    good = sound & (assembly.energy() <= energy + 1e-4 * length * slope)
                shrink = np.where(sound, slope / (slope - sums.slope), 0.5)
            good = np.where(predicting, sound | (length == 0), good)
            open_ &= ~good
            if not open_.any():
                break
            shrink = np.clip(np.nan_to_num(shrink, nan=0.5), 0.1, 0.7)
            shrink[predicting] = 0.0
            length[open_] *= shrink[open_]
        if open_.any():
            stuck = self.mask(open_)
            copy_active(stuck, self._start, state.u)
            assembly.evaluate(stuck, state.u, direction)
        return running & ~open_, length

    def _walk(self, trying, length: np.ndarray) -> None:
        assembly = self._assembly
        lengths = wp.array(
            length.astype(numpy_of(assembly.real)), dtype=assembly.real, device=assembly.device
        )
        walk(trying, lengths, self._start, self._cg.solution, assembly.state.u)

    def mask(self, chosen: np.ndarray):
        """The chosen environments (B,) as the kernels take them."""
        return wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self._assembly.device)
