# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""Newton's method on a batch in which every environment has its own step and iteration.

The tangent is solved inexactly, and steps are accepted by the slope along them: the directional
derivative keeps its digits where a difference of energies is lost in round-off. With friction the
limit follows the pressure from iteration to iteration, so that the coupled state converges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.fem import Fem
from sim.fem.arrays import array_of, axpy, copy_active
from sim.fem.assembly import Assembly
from sim.fem.cg import ConjugateGradient
from sim.fem.element import SETTLINGS, STIFFER
from sim.scene import Scene

# Least determinant of the deformation gradient of a trial state, and of an accepted one.
DET_TRIAL, DET_FLOOR = 0.02, 0.05
# Most step lengths tried along one direction.
TRIALS = 12

# Largest and least accuracy of a linear solve; 0.3 times the residual in between. More accurate
# solves cost more iterations of the linear solver than they save of Newton's.
ACCURACY, ACCURACY_LEAST = 0.1, 3e-3
# Accuracy of the linear solve that follows the tip. With 0.1 the touching skin moves alone, the
# body below it is crushed, and Newton's method takes up to three times the iterations.
PREDICTION = 0.01
# Below this fraction of a full step, or if the tangent is not convex, the next tangent is made
# convex; if it already was, it is damped.
LENGTH_GOOD = 0.2
# Residual below which a tangent that was made convex is exact again; it is multiplied by the second
# whenever that was too early.
EXACT_BELOW, EXACT_LESS = 0.1, 1 / 3
# A step has failed after this many iterations without a residual below the second times the best
# one: where skin folds, states wander without end.
PATIENCE, BETTER = 25, 0.7
# Patience and `Fem.newton_max` of a patient step over those of others, while the residual is above
# the second times the tolerance; below, rounding is the limit. Skin that folds, or slides around an
# edge, goes from one state to a distant one; it may take 150 iterations, in all of which its energy
# falls. No shorter step of the tip avoids them, nor those after an update of the multipliers.
PATIENT, ROUNDING = 6, 10.0
# Iterations beyond `PATIENCE` that all patient steps of a path may take: skin that folds again and
# again has no state that a result could be made of.
PATIENT_IN_ALL = 300
# Iterations of a step with a convex tangent, after which the exact one is damped instead: where a
# body turns far, the convex tangent is too stiff to make progress.
CONVEX_MOST = 10
# Least and most damping, a stiffness against any motion [E / T^2]: from that of the softest to that
# of the stiffest motion of the body. It is divided by 4 with every good step.
DAMPING_LEAST, DAMPING_MOST = 2.0, 1e5
# Longest step [T] over which the work of the indenter follows accurately enough from the two ends.
# With viscosity, whose steps are short in time, a state in between would add 5 % to the run time.
WORK_STEP, WORK_STEP_VISCOUS = 1 / 30, 1 / 12
# Iterations in which friction's limit follows the pressure fully; later it moves by the second, a
# fraction of the way. Otherwise the two may alternate for ever with equal and opposite changes.
RELAX_AFTER, RELAX_SHARE = 4, 0.5


class Newton:
    """Nonlinear solver of one assembly, with its work arrays and counts per environment (B,)."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        count, nodes = assembly.environments, len(assembly.mesh.nodes)
        self._cg = ConjugateGradient(
            assembly.real,
            count,
            nodes,
            str(assembly.device),
            assembly.block_matrix,
            assembly.preconditioner,
        )
        self._start = wp.zeros_like(assembly.state.u)
        self._friction = "friction" in assembly.effects
        self.residual = np.full(count, np.inf)
        """Out-of-balance force over force of the current state."""
        self.iterations = np.zeros(count, int)
        """Newton iterations since `begin`."""
        self.cg = np.zeros(count, int)
        """Conjugate-gradient iterations since `begin`."""
        self.converged = np.zeros(count, bool)
        """True if the current state is in balance."""
        self.failed = np.zeros(count, bool)
        """True if the solver cannot continue from the current state."""
        self.crushed = np.zeros(count, bool)
        """True if elements of a failed step have all but lost their volume."""
        self._predicting = np.zeros(count, bool)
        self._tolerance = np.full(count, assembly.numerics.tolerance)
        self._damping = np.zeros(count)
        self._convex = np.zeros(count, bool)
        self._exact_below = np.full(count, EXACT_BELOW)
        self._convex_left = np.full(count, CONVEX_MOST)
        self._best = np.full(count, np.inf)
        self._best_at, self._far_at = np.zeros((2, count), int)
        self._settled, self._renewed = np.zeros((2, count), int)
        self._patience = np.ones(count)
        self._mask = assembly.state.mask
        self._whole = wp.ones(count, dtype=assembly.real, device=assembly.device)

    def begin(
        self,
        chosen: np.ndarray,
        tolerance: np.ndarray,
        *,
        predict: np.ndarray,
        patience: np.ndarray,
    ) -> None:
        """Start a step of the chosen environments from `state.u`; all arrays (B,).

        It may take `patience` times as many iterations as usual.

        Where `predict` is set, `state.u` is the state before the tip moved. The first iteration
        then follows the tip along the tangent and contact of that state.
        """
        if not chosen.any():
            return
        self._tolerance[chosen] = tolerance[chosen]
        self._predicting[chosen] = predict[chosen]
        state = self._assembly.state
        if self._friction:
            state.settle_limit(self._mask(chosen))
        state.set_tip(chosen & predict, before=True)
        state.set_tip(chosen & ~predict)
        self._patience[chosen] = patience[chosen]
        self._restart(chosen)

    def resume(self, chosen: np.ndarray, patience: np.ndarray) -> None:
        """Continue from the current state, a solution, after an update of its multipliers.

        `patience` is as in `begin`.
        """
        if not chosen.any():
            return
        self._patience[chosen] = patience[chosen]
        self._restart(chosen)

    def _restart(self, chosen: np.ndarray) -> None:
        self.iterations[chosen], self.cg[chosen] = 0, 0
        self.residual[chosen], self._damping[chosen] = np.inf, 0.0
        self._exact_below[chosen], self._convex_left[chosen] = EXACT_BELOW, CONVEX_MOST
        self._best[chosen], self._best_at[chosen], self._far_at[chosen] = np.inf, 0, 0
        self._settled[chosen], self._renewed[chosen] = 0, 0
        if self._assembly.split:
            self._assembly.state.volume.stiffen(chosen, 0.0)
            self._assembly.state.follow_volume(self._mask(chosen))
        self._switch(chosen & self._convex)
        self.converged[chosen], self.failed[chosen] = False, False
        state = self._assembly.state
        self._assembly.evaluate(self._mask(chosen), state.u, self._cg.solution)
        self._check_convergence(chosen & ~self._predicting)

    def sweep(
        self,
        running: np.ndarray,
        meanwhile: Callable[[Callable[[], bool]], None] | None = None,
    ) -> None:
        """Run one iteration of the environments (B,) that are neither converged nor failed.

        `meanwhile` is as in `ConjugateGradient.solve`.
        """
        assembly, state = self._assembly, self._assembly.state
        active, predicting = self._mask(running), running & self._predicting
        if self._friction:
            late = running & (self.iterations >= RELAX_AFTER)
            state.relax_limit(self._mask(running & ~late), 1.0)
            if late.any():
                slow = self._mask(late)
                state.relax_limit(slow, RELAX_SHARE)
                assembly.evaluate_contact(slow, state.u, self._cg.solution)
        assembly.linearise(active, state.u, self._damping)
        if predicting.any():
            assembly.push(self._mask(predicting), state.travel(predicting))
        accuracy = np.clip(0.3 * self.residual, ACCURACY_LEAST, ACCURACY)
        accuracy[predicting] = PREDICTION
        used = self._cg.solve(
            running,
            assembly.residual,
            np.where(running, accuracy, 1.0),
            assembly.numerics.cg_max,
            meanwhile,
        )
        self.cg[running] += used[running]
        assembly.preconditioner.learn(np.where(running, used, 0), accuracy)
        self.iterations[running] += 1
        slope, concave = self._cg.status()
        state.set_tip(predicting)
        walked, length = self._search(active, running, predicting, slope)
        self._predicting[running] = False
        hard = ~predicting & (concave | (length < LENGTH_GOOD) | ~walked)
        self._convex_left[running & self._convex] -= 1
        spared = self._convex_left > 0
        bent = hard & ~self._convex & spared
        hard &= ~bent
        stiffer = np.clip(self._damping * 8, DAMPING_LEAST, DAMPING_MOST)
        damping = np.where(hard, stiffer, self._damping / 4)
        damping[damping < DAMPING_LEAST] = 0.0
        self._damping[running] = damping[running]
        self._check_convergence(running)
        eased = self._convex & (self._damping == 0) & (self.residual < self._exact_below)
        eased |= self._convex & ~spared
        self._exact_below[running & eased] *= EXACT_LESS
        switched = running & (bent | eased)
        if self._switch(switched):
            assembly.evaluate_contact(self._mask(switched), state.u, self._cg.solution)
        better = running & (self.residual < BETTER * self._best)
        self._best[better], self._best_at[better] = self.residual[better], self.iterations[better]
        far = running & (self.residual > ROUNDING * self._tolerance)
        self._far_at[far] = self.iterations[far]
        spent = self.iterations - self._renewed >= assembly.numerics.newton_max * self._patience
        spent |= self.iterations - self._best_at >= PATIENCE * self._patience
        spent |= self.iterations - np.maximum(self._best_at, self._far_at) >= PATIENCE
        stuck = ~walked & (damping >= DAMPING_MOST)
        self.failed |= running & ~self.converged & (spent | stuck)
        self.crushed = self.failed & (assembly.sums["det"] <= DET_FLOOR)

    def _switch(self, chosen: np.ndarray) -> bool:
        """Switch tangents of the chosen (B,) between convex and exact; return True if any."""
        self._convex ^= chosen
        if chosen.any():
            self._assembly.make_convex(self._convex)
        return bool(chosen.any())

    def _check_convergence(self, chosen: np.ndarray) -> None:
        """Check which of the chosen (B,) have converged and which have failed."""
        if not chosen.any():
            return
        assembly, state = self._assembly, self._assembly.state
        if self._friction:
            active = self._mask(chosen)
            state.settle_limit(active)
            assembly.evaluate_contact(active, state.u, self._cg.solution)
        is_valid, balanced = self._balance(chosen)
        if assembly.split and balanced.any():
            assembly.settle_volume(self._mask(balanced), self._cg.solution)
            moved = balanced.copy()
            balanced = self._balance(balanced)[1]
            self._renew(moved & ~balanced)
        good = assembly.sums["det"] > DET_FLOOR
        self.converged |= balanced & good
        self.failed |= (chosen & ~is_valid) | (balanced & ~good)

    def _renew(self, chosen: np.ndarray) -> None:
        """Continue after the pressure of nearly incompressible bodies has followed (B,)."""
        if not chosen.any():
            return
        self._settled[chosen] += 1
        self._best[chosen], self._renewed[chosen] = np.inf, self.iterations[chosen]
        self._best_at[chosen] = self._far_at[chosen] = self.iterations[chosen]
        slow = chosen & (self._settled % SETTLINGS == 0)
        if slow.any():
            state = self._assembly.state
            state.volume.stiffen(slow, STIFFER)
            state.follow_volume(self._mask(slow))
            self._assembly.evaluate(self._mask(slow), state.u, self._cg.solution)
            self._balance(slow)

    def _balance(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Set the residual of the chosen (B,); return which are valid, and which balanced too."""
        assembly = self._assembly
        sums = assembly.sums
        force = np.maximum(np.sqrt(sums["applied"]), assembly.min_force_scale)
        self.residual[chosen] = (np.sqrt(sums["square"]) / force)[chosen]
        is_valid = np.isfinite(self.residual) & (sums["det"] > DET_TRIAL)
        return is_valid, chosen & is_valid & (self.residual <= self._tolerance)

    def _search(self, active, running, predicting, slope) -> tuple[np.ndarray, np.ndarray]:
        """Search along the direction; return success (B,) and step length (B,).

        A prediction is taken in full, or not at all if it leads to an invalid state.
        """
        assembly, state = self._assembly, self._assembly.state
        direction = self._cg.solution
        copy_active(active, state.u, self._start)
        length = np.ones(assembly.environments)
        open_ = running.copy()
        for _trial in range(TRIALS):
            trying = self._mask(open_)
            self._walk(trying, length)
            sums = assembly.evaluate(trying, state.u, direction)
            with np.errstate(invalid="ignore", divide="ignore"):
                finite = np.isfinite(sums["square"]) & np.isfinite(sums["slope"])
                is_valid = finite & (sums["det"] > DET_TRIAL)
                good = is_valid & self._eased(sums, slope)
                shrink = np.where(is_valid, slope / (slope - sums["slope"]), 0.5)
            good = np.where(predicting, is_valid | (length == 0), good)
            open_ &= ~good
            if not open_.any():
                break
            shrink = np.clip(np.nan_to_num(shrink, nan=0.5), 0.1, 0.7)
            shrink[predicting] = 0.0
            length[open_] *= shrink[open_]
        if open_.any():
            stuck = self._mask(open_)
            copy_active(stuck, self._start, state.u)
            assembly.evaluate(stuck, state.u, direction)
        return running & ~open_, length

    def _eased(self, sums: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """True if a step reduces the slope to at most half of its start value (B,)."""
        return sums["slope"] <= 0.5 * np.abs(slope)

    def _walk(self, trying, length: np.ndarray) -> None:
        assembly = self._assembly
        axpy(trying, self._lengths(length), self._start, self._cg.solution, assembly.state.u)

    def _lengths(self, length: np.ndarray):
        """Return lengths (B,) as an array for the kernels; most steps are whole."""
        assembly = self._assembly
        if (length == 1.0).all():
            return self._whole
        return array_of(length, assembly.real, assembly.real, assembly.device)

    def work(self, chosen: np.ndarray, duration: np.ndarray) -> np.ndarray:
        """Return the indenter's work over the step that led to the current state (B,) [E T^3].

        Work on the skin is integrated from both ends of the step. For a long step the energy that
        the body takes up half-way is added (Simpson's rule).

        Args:
            chosen: Environments whose step has converged (B,); their state does not change.
            duration: Time of the current step of each environment (B,) [s].
        """
        assembly, state = self._assembly, self._assembly.state
        work = assembly.work(chosen)
        longest = WORK_STEP_VISCOUS if "viscosity" in assembly.effects else WORK_STEP
        long = chosen & (np.linalg.norm(state.step, axis=1) > longest)
        if self._friction or not long.any():
            return work
        active, way = self._mask(long), self._cg.solution
        axpy(active, self._lengths(np.full(len(long), -1.0)), state.u, state.contact.u_old, way)
        axpy(active, self._lengths(np.full(len(long), 0.5)), state.contact.u_old, way, self._start)
        state.put_within(long, 0.5, duration, way)
        state.put_tip_away(long)
        middle = assembly.evaluate(active, self._start, way)["slope"]
        state.put_within(long, 1.0, duration, way)
        state.set_tip(long)
        assembly.evaluate(active, state.u, way)
        return np.where(long, (work + 2 * middle) / 3, work)


# Path of one press along its motion: the choice of steps, and the halving of failed ones.

Array = NDArray[np.float64]

# Time [s] after which any material has relaxed: how long a body stood before a motion begins.
FULL_RELAXATION_TIME = 1e9
# Failed attempts, of ever shorter steps from one place, after which the next may take long.
PATIENT_AFTER = (2, 5)
# Determinant of the last accepted state, over the least accepted one, below which its elements are
# all but crushed; and the number of shorter and shorter steps that may then fail by crushing them.
NEARLY_CRUSHED, CRUSHED_MOST = 2.0, 2
# Steps of a path that may end with the skin inside itself, or leap through the indenter, and be
# halved. A shorter one may lead to a state without a fold; one that grows with the depth does so in
# any steps.
CROSSED_MOST = 3
# Largest ratio of a step to the last one that was accepted.
GROWTH = 1.5
# Steps per shortest relaxation time, but at most `STEPS_MAX` in a segment.
RELAXATION_STEPS = 4
STEPS_MAX = 16
# Longest step in sides of the smallest elements, if the mesh follows the contact, and the number of
# steps in the depth that need not be exceeded. Longer steps bring too many elements into contact at
# once, and Newton's method takes several times the iterations.
FINE_STEPS, DEPTH_STEPS = 1.0, 10.0


@dataclass(slots=True)
class Path:
    """Progress of one press along its motion; lengths in thicknesses.

    Segment 0 leads from above the body straight to the first waypoint, in no time: a motion that
    begins inside the body arrived there at once. Segment k leads to waypoint k. Weight acts from
    the start; if the body does not converge under all of it, it is ramped up over segment 0.
    """

    corners: Array
    """Start and waypoints (F + 1, 3)."""
    times: Array
    """Time of each corner [s] (F + 1,); the first is before the body was touched."""
    longest: float
    """Length of the longest step."""
    shortest_time: float
    """Shortest time that a step has to resolve [s]; inf if nothing depends on time."""
    halvings_max: int
    heavy: bool = False
    """True if the body has weight."""
    ramped: bool = False
    """True if the weight is ramped up over segment 0."""
    segment: int = 0
    fraction: float = 0.0
    """Completed fraction of the segment."""
    step: float = 1.0
    """Fraction of the segment that the next step may take."""
    halvings: int = 0
    failed: int = 0
    """Failed attempts since the last accepted step."""
    hard: bool = False
    """True if another batch, in float32, has failed on this path."""
    patient_left: int = PATIENT_IN_ALL
    """Iterations that patient steps may still take."""
    nearly_crushed: bool = False
    """True if elements of the last accepted state have little volume left."""
    crushed: int = 0
    """Steps since then that failed because elements lost their volume."""
    crossed: int = 0
    """Steps of the whole path in which something has passed through the skin."""
    ended: str = ""
    """Reason why shorter steps are of no use, if so."""
    tried: list[str] = field(default_factory=list)

    @property
    def patient(self) -> bool:
        """True if the next step may take long, as shorter ones would not help."""
        return self.failed in PATIENT_AFTER or (self.hard and self.failed == 0)

    def patience(self, newton_max: int) -> float:
        """Return how many times as many iterations as usual a patient step may take."""
        return 1.0 + min(PATIENT - 1.0, max(self.patient_left, 0) / newton_max)

    @property
    def finished(self) -> bool:
        """True if the last waypoint was reached."""
        return self.segment == len(self.corners) - 1

    @property
    def length(self) -> float:
        """Length of the current segment."""
        return self._length_of(self.segment)

    @property
    def limit(self) -> float:
        """Largest fraction of the segment that one step may take."""
        return 1.0 / self._steps_of(self.segment)

    @property
    def steps(self) -> float:
        """Number of steps of all segments, if none is halved."""
        return sum(self._steps_of(segment) for segment in range(len(self.corners) - 1))

    def _length_of(self, segment: int) -> float:
        return float(np.linalg.norm(self.corners[segment + 1] - self.corners[segment]))

    def _steps_of(self, segment: int) -> float:
        duration = self.times[segment + 1] - self.times[segment]
        by_time = min(STEPS_MAX, max(1.0, duration / self.shortest_time * RELAXATION_STEPS))
        if not segment:
            by_time = 1.0
        by_way = np.ceil(self._length_of(segment) / self.longest)
        return float(max(1.0, by_way, np.ceil(by_time)))

    def goal(self) -> tuple[float, Array, float]:
        """Return the fraction of the segment after the next step, tip (3,), and time [s]."""
        step = min(self.step, self.limit)
        left = 1.0 - self.fraction
        step = left if left < 1.2 * step else min(step, left)
        fraction = 1.0 if step == left else self.fraction + step
        start, end = self.corners[self.segment], self.corners[self.segment + 1]
        duration = (self.times[self.segment + 1] - self.times[self.segment]) * step
        if self.segment == 0:
            duration = FULL_RELAXATION_TIME if self.length == 0 else 0.0
        return fraction, start + (end - start) * fraction, float(duration)

    def load(self, fraction: float) -> float:
        """Return the fraction of the weight that acts after a fraction of the current segment."""
        return fraction if self.ramped and self.segment == 0 else 1.0

    def accept(self, fraction: float, *, nearly_crushed: bool = False) -> bool:
        """Accept the step; return True if a waypoint was reached."""
        step = fraction - self.fraction
        self.failed = self.crushed = 0
        self.nearly_crushed = nearly_crushed
        if fraction < 1.0:
            self.fraction = fraction
            self.step = step * GROWTH
            return False
        travel = step * self.length
        self.segment += 1
        self.fraction, self.halvings = 0.0, 0
        self.tried.clear()
        self.step = 1.0
        if not self.finished and self.length > 0 and travel > 0:
            self.step = max(travel, 0.25 * self.longest) * GROWTH / self.length
        return True

    def go_on(self, halvings_max: int) -> None:
        """Try the failed step again, now with up to `halvings_max` halvings.

        First attempts are patient from now on.
        """
        self.step *= 2.0**self.failed
        self.halvings, self.halvings_max, self.failed = 0, halvings_max, 0
        self.hard = True
        self.tried.clear()

    def refuse(
        self, fraction: float, message: str, *, crushed: bool = False, crossed: str = ""
    ) -> bool:
        """Reject the step and halve it; return True if there is a smaller one to try.

        `crushed` is set if its elements have lost their volume. `crossed` says where something has
        passed through its skin, if it has.
        """
        step = fraction - self.fraction
        self.tried.append(f"segment {self.segment}, step of {step:.3g} of it: {message}")
        self.ramped |= self.heavy and self.segment == 0 and self.fraction == 0
        self.step = step / 2
        self.halvings += 1
        self.failed += 1
        self.crushed += crushed
        self.crossed += bool(crossed)
        if crossed and (self.crossed == CROSSED_MOST or not self.length):
            self.ended = crossed
        elif self.nearly_crushed and self.crushed >= CRUSHED_MOST:
            self.ended = "elements are crushed: the skin folds there, or is pressed flat"
        elif self.patient_left <= 0 and self.failed >= PATIENT_AFTER[0]:
            self.ended = f"{PATIENT_IN_ALL} further iterations have not led past such places"
        if self.ended:
            return False
        return self.halvings <= self.halvings_max and (
            self.length > 0 or (self.ramped and self.segment == 0)
        )


def path_of(scene: Scene, numerics: Fem, finest: float = np.inf) -> Path:
    """Return the path of a scene's tip, in units of the body's thickness.

    `finest` is the side of the smallest elements, if the mesh follows the contact.
    """
    unit = scene.body.thickness
    tip = np.asarray(scene.motion.tip) / unit
    start = tip[0].copy()
    start[2] = max(start[2], 0.0)
    longest = max(scene.indenter.sharpest / 2, unit / 50)
    if numerics.step_travel is not None:
        longest = min(longest, numerics.step_travel)
    elif scene.effects.friction is not None:
        longest = min(longest, unit / 40)
    longest = min(longest, max(FINE_STEPS * finest * unit, scene.motion.depth_max / DEPTH_STEPS))
    shortest = np.inf
    if scene.effects.viscosity is not None:
        shortest = min(scene.effects.viscosity.times)
    return Path(
        corners=np.concatenate([start[None], tip]),
        times=np.concatenate([[0.0], np.asarray(scene.motion.time)]),
        longest=longest / unit,
        shortest_time=shortest,
        halvings_max=numerics.halvings,
        heavy=scene.effects.gravity is not None,
    )
