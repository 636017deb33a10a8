# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""Newton's method on a batch in which every environment is at its own iteration of its own step.

Tangent solved inexactly, steps accepted by the slope along them: the directional derivative keeps
its digits where a difference of energies drowns in round-off. With friction the limit follows the
pressure from iteration to iteration, so that what converges is the coupled state.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.fem.assembly import Assembly, Sums
from sim.fem.cg import ConjugateGradient
from sim.fem.numerics import ELASTIC_EVERY, Numerics
from sim.fem.vectors import copy_active, walk
from sim.scalars import numpy_of
from sim.scene import Scene

# Smallest force that residuals are measured against [E T^2]: 2 mN in the paper's gel in float32, so
# that a tolerance of 1e-4 asks for no more than 0.2 uN, about what its digits can give.
FORCE_FLOOR = {"float32": 1e-3, "float64": 1e-5}
# No trial state may be compressed further than this anywhere.
DET_TRIAL = 0.02
# Step lengths tried along one direction.
TRIALS = 12

# Accuracy of a linear solve, largest and least; 0.3 of the residual over the force between. Finer
# solves cost more iterations of the linear solver than they save of Newton's.
ACCURACY, ACCURACY_LEAST = 0.1, 3e-3
# Accuracy of the linear solve that follows the tip: with 0.1 the touching skin moves alone, the
# body below it is crushed, and Newton's method takes up to three times the iterations.
PREDICTION = 0.01
# Below this share of a full step, or where the tangent is not convex, the next tangent is made
# convex, and where it was, damped.
LENGTH_GOOD = 0.2
# Residual below which a tangent that was made convex is exact again; times the second whenever that
# was too early.
EXACT_BELOW, EXACT_LESS = 0.1, 1 / 3
# Iterations without a residual below so much of the best one, after which a step has failed: where
# skin folds, states wander without an end.
PATIENCE, BETTER = 25, 0.7
# Iterations of a step with a tangent that was made convex, after which the exact one is damped:
# where a body turns far, the convex one is too stiff to get anywhere.
CONVEX_MOST = 10
# Stiffness against any motion that is added then [E / T^2], least and most: from that of the
# softest to that of the stiffest motion of the body. It shrinks by 4 with every good step.
DAMPING_LEAST, DAMPING_MOST = 2.0, 1e5
# Longest step [T] over which the work of the indenter is told well enough by the two ends: with
# viscosity, whose steps are short in time, a state between them would cost 5 % of the whole.
WORK_STEP, WORK_STEP_VISCOUS = 1 / 30, 1 / 12
# Friction's limit follows the pressure at once for the first iterations, later half of the way: the
# two may answer each other with equal and opposite changes for ever.
RELAX_AFTER, RELAX_SHARE = 4, 0.5


class Newton:
    """The nonlinear solver of one assembly; owns its work space, and counts by environment (B,)."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        count, nodes = assembly.environments, len(assembly.mesh.nodes)
        self._cg = ConjugateGradient(
            assembly.real, count, nodes, str(assembly.device), assembly.stencil, assembly.lines
        )
        self._start = wp.zeros_like(assembly.state.u)
        self._friction = "friction" in assembly.effects
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
        self._convex, self._switched = np.zeros((2, count), bool)
        self._exact_below = np.full(count, EXACT_BELOW)
        self._convex_left = np.full(count, CONVEX_MOST)
        self._best, self._best_at = np.full(count, np.inf), np.zeros(count, int)

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
        self._exact_below[chosen], self._convex_left[chosen] = EXACT_BELOW, CONVEX_MOST
        self._best[chosen], self._best_at[chosen] = np.inf, 0
        self._switch(chosen & self._convex)
        self.converged[chosen], self.failed[chosen] = False, False
        state = self._assembly.state
        self._assembly.evaluate(self.mask(chosen), state.u, self._cg.solution)
        self._judge(chosen & ~self._predicting)

    def sweep(self, running: np.ndarray) -> None:
        """One iteration of every running environment (B,) that is neither converged nor failed."""
        assembly, state = self._assembly, self._assembly.state
        active, predicting = self.mask(running), running & self._predicting
        if self._friction:
            late = running & (self.iterations >= RELAX_AFTER)
            state.relax_limit(self.mask(running & ~late), 1.0)
            if late.any():
                slow = self.mask(late)
                state.relax_limit(slow, RELAX_SHARE)
                assembly.evaluate_contact(slow, state.u, self._cg.solution)
        anew = None
        if assembly.stencil.keeps:
            due = (self.iterations % ELASTIC_EVERY == 0) | (self._damping > 0)
            anew = self.mask(running & (due | self._convex | self._switched))
        self._switched[running] = False
        assembly.linearise(active, state.u, self._damping, anew)
        if predicting.any():
            assembly.push(self.mask(predicting), state.travel(predicting))
        accuracy = np.clip(0.3 * self.residual, ACCURACY_LEAST, ACCURACY)
        accuracy[predicting] = PREDICTION
        used = self._cg.solve(
            active,
            assembly.residual,
            np.where(running, accuracy, 1.0),
            assembly.numerics.cg_max,
        )
        self.cg[running] += used[running]
        assembly.lines.learn(np.where(running, used, 0))
        self.iterations[running] += 1
        slope, concave = self._cg.verdict()
        state.put_tip(predicting)
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
        self._judge(running)
        eased = self._convex & (self._damping == 0) & (self.residual < self._exact_below)
        eased |= self._convex & ~spared
        self._exact_below[running & eased] *= EXACT_LESS
        if self._switch(running & (bent | eased)):
            assembly.evaluate_contact(
                self.mask(running & self._switched), state.u, self._cg.solution
            )
        better = running & (self.residual < BETTER * self._best)
        self._best[better], self._best_at[better] = self.residual[better], self.iterations[better]
        spent = self.iterations >= assembly.numerics.newton_max
        spent |= self.iterations - self._best_at >= PATIENCE
        stuck = ~walked & (damping >= DAMPING_MOST)
        self.failed |= running & ~self.converged & (spent | stuck)

    def _switch(self, chosen: np.ndarray) -> bool:
        """Make tangents of the chosen (B,) convex, or exact where they were; whether any was."""
        self._convex ^= chosen
        self._switched |= chosen
        if chosen.any():
            self._assembly.make_convex(self._convex)
        return bool(chosen.any())

    def _judge(self, chosen: np.ndarray) -> None:
        """Find out which of the chosen are in balance, and which are beyond repair."""
        if not chosen.any():
            return
        assembly, state = self._assembly, self._assembly.state
        if self._friction:
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
        direction = self._cg.solution
        copy_active(active, state.u, self._start)
        length = np.ones(assembly.environments)
        open_ = running.copy()
        for _trial in range(TRIALS):
            trying = self.mask(open_)
            self._walk(trying, length)
            sums = assembly.evaluate(trying, state.u, direction)
            with np.errstate(invalid="ignore", divide="ignore"):
                sound = np.isfinite(sums.square) & np.isfinite(sums.slope) & (sums.det > DET_TRIAL)
                good = sound & self._eased(sums, slope)
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

    def _eased(self, sums: Sums, slope: np.ndarray) -> np.ndarray:
        """Whether a step leads to no more than half of the slope that it began with (B,)."""
        return sums.slope <= 0.5 * np.abs(slope)

    def _walk(self, trying, length: np.ndarray) -> None:
        assembly = self._assembly
        walk(trying, self._lengths(length), self._start, self._cg.solution, assembly.state.u)

    def _lengths(self, length: np.ndarray):
        """Lengths (B,) as the kernels take them."""
        assembly = self._assembly
        return wp.array(
            length.astype(numpy_of(assembly.real)), dtype=assembly.real, device=assembly.device
        )

    def work(self, chosen: np.ndarray, duration: np.ndarray) -> np.ndarray:
        """Work of the indenter over the step that led the chosen to where they are (B,) [E T^3].

        What it does to the skin is integrated by both ends of the step, and by what the body takes
        up half of the way where the step is long (Simpson's rule).

        Args:
            chosen: Whose step has converged (B,); their present state stays as it is.
            duration: Time of the step that each environment is in (B,) [s].
        """
        assembly, state = self._assembly, self._assembly.state
        work = assembly.work(chosen)
        longest = WORK_STEP_VISCOUS if "viscosity" in assembly.effects else WORK_STEP
        long = chosen & (np.linalg.norm(state.step, axis=1) > longest)
        if self._friction or not long.any():
            return work
        active, way = self.mask(long), self._cg.solution
        walk(active, self._lengths(np.full(len(long), -1.0)), state.u, state.u_old, way)
        walk(active, self._lengths(np.full(len(long), 0.5)), state.u_old, way, self._start)
        state.put_within(long, 0.5, duration, way)
        state.put_tip_away(long)
        between = assembly.evaluate(active, self._start, way).slope
        state.put_within(long, 1.0, duration, way)
        state.put_tip(long)
        assembly.evaluate(active, state.u, way)
        return np.where(long, (work + 2 * between) / 3, work)

    def mask(self, chosen: np.ndarray):
        """The chosen environments (B,) as the kernels take them."""
        return wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self._assembly.device)


# One press's way along its motion: which step comes next, and what a failed one costs.

Array = NDArray[np.float64]

# Time [s] after which any material has relaxed: how long a body stood before a motion begins.
REST = 1e9
# How much longer a step may be than the last one that was accepted.
GROWTH = 1.5
# Steps within the shortest relaxation time, but at most `STEPS_MAX` in a segment.
RELAXATION_STEPS = 4
STEPS_MAX = 16
# Sides of the smallest elements that a step may go where the mesh follows the contact, and the
# steps in the depth that it need not fall below: longer steps bring so many elements into contact
# at once that Newton's method takes several times the iterations.
FINE_STEPS, DEPTH_STEPS = 1.0, 10.0


@dataclass(slots=True)
class Path:
    """Where one press stands on its motion; lengths in thicknesses.

    Segment 0 leads from above the body straight to the first waypoint, in no time: a motion that
    begins inside the body arrived there at once. Segment k leads to waypoint k. Weight is there
    from the start; where the body does not find its shape under all of it at once, segment 0 brings
    it up along its way.
    """

    corners: Array
    """Start and waypoints (F + 1, 3)."""
    times: Array
    """Time of each of them [s] (F + 1,); the first is before the body was touched."""
    longest: float
    """Longest step."""
    shortest_time: float
    """Shortest time that a step has to resolve [s]; inf when nothing depends on time."""
    halvings_max: int
    heavy: bool = False
    """Whether the body has weight."""
    ramped: bool = False
    """Whether segment 0 brings the weight up."""
    segment: int = 0
    share: float = 0.0
    """Share of the segment that is done."""
    step: float = 1.0
    """Share of the segment that the next step may take."""
    halvings: int = 0
    tried: list[str] = field(default_factory=list)

    @property
    def finished(self) -> bool:
        """Whether the last waypoint was reached."""
        return self.segment == len(self.corners) - 1

    @property
    def length(self) -> float:
        """Length of the present segment."""
        return self._length_of(self.segment)

    @property
    def limit(self) -> float:
        """Largest share of the segment that one step may take."""
        return 1.0 / self._steps_of(self.segment)

    @property
    def steps(self) -> float:
        """Steps of all segments, if none is halved."""
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
        """Share of the segment after the next step, the tip there (3,), and the step's time [s]."""
        step = min(self.step, self.limit)
        left = 1.0 - self.share
        step = left if left < 1.2 * step else min(step, left)
        share = 1.0 if step == left else self.share + step
        start, end = self.corners[self.segment], self.corners[self.segment + 1]
        duration = (self.times[self.segment + 1] - self.times[self.segment]) * step
        if self.segment == 0:
            duration = REST if self.length == 0 else 0.0
        return share, start + (end - start) * share, float(duration)

    def load(self, share: float) -> float:
        """Share of the weight that there is after a share of the present segment."""
        return share if self.ramped and self.segment == 0 else 1.0

    def accept(self, share: float) -> bool:
        """Take the step; whether a waypoint was reached."""
        step = share - self.share
        if share < 1.0:
            self.share = share
            self.step = step * GROWTH
            return False
        travel = step * self.length
        self.segment += 1
        self.share, self.halvings = 0.0, 0
        self.tried.clear()
        self.step = 1.0
        if not self.finished and self.length > 0 and travel > 0:
            self.step = max(travel, 0.25 * self.longest) * GROWTH / self.length
        return True

    def refuse(self, share: float, said: str) -> bool:
        """Give the step up and halve it; whether there is a smaller one to try."""
        step = share - self.share
        self.tried.append(f"segment {self.segment}, step of {step:.3g} of it: {said}")
        self.ramped |= self.heavy and self.segment == 0 and self.share == 0
        self.step = step / 2
        self.halvings += 1
        return self.halvings <= self.halvings_max and (
            self.length > 0 or (self.ramped and self.segment == 0)
        )


def path_of(scene: Scene, numerics: Numerics, finest: float = np.inf) -> Path:
    """The way of a scene's tip, in units of the body's thickness.

    Args:
        scene: Whose tip.
        numerics: What limits its steps.
        finest: Side of the smallest elements, where the mesh follows the contact.
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
