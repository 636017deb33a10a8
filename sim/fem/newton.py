# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""Newton's method on a batch in which every environment has its own step and iteration.

Its linear equations are solved by conjugate gradients, in the second half of this file.

The tangent is solved inexactly, and steps are accepted by the slope along them: the directional
derivative keeps its digits where a difference of energies is lost in round-off. With friction the
limit follows the pressure from iteration to iteration, so that the coupled state converges.
"""

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from sim.device import kernel
from sim.fem.arrays import Graphs, array_of, axpy, copy_active
from sim.fem.assembly import Assembly
from sim.fem.balance import LANES
from sim.fem.element import SETTLINGS, STIFFER
from sim.scalars import vector_of

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
# Friction's limit follows the pressure, but for a time by only the first, a fraction of the way,
# after an iteration beyond the second that left more than the third of the residual: the two may
# alternate for ever with equal and opposite changes. That time is the fourth, and longer each time.
RELAX_SHARE, RELAX_AFTER, RELAX_ABOVE, RELAX_FOR = 0.5, 4, 0.7, 4


class Newton:
    """Nonlinear solver of one assembly, with its work arrays and counts per environment (B,)."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        count, nodes = assembly.environments, len(assembly.mesh.nodes)
        tangent = assembly.block_matrix, assembly.preconditioner
        self._cg = ConjugateGradient(assembly.real, count, nodes, str(assembly.device), *tangent)
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
        self._relaxed_for, self._relaxed_until = np.zeros((2, count), int)
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
        self._predicting[chosen] = predict[chosen]
        state = self._assembly.state
        if self._friction:
            state.settle_limit(self._mask(chosen))
        state.set_tip(chosen & predict, before=True)
        state.set_tip(chosen & ~predict)
        self.resume(chosen, tolerance, patience)

    def resume(self, chosen: np.ndarray, tolerance: np.ndarray, patience: np.ndarray) -> None:
        """Continue from the solution, after an update of multipliers; all as in `begin`."""
        self._tolerance[chosen], self._patience[chosen] = tolerance[chosen], patience[chosen]
        self.iterations[chosen], self.cg[chosen] = 0, 0
        self.residual[chosen], self._damping[chosen] = np.inf, 0.0
        self._exact_below[chosen], self._convex_left[chosen] = EXACT_BELOW, CONVEX_MOST
        self._best[chosen], self._best_at[chosen], self._far_at[chosen] = np.inf, 0, 0
        self._settled[chosen], self._renewed[chosen] = 0, 0
        self._relaxed_for[chosen], self._relaxed_until[chosen] = 0, 0
        if self._assembly.split:
            self._assembly.state.volume.stiffen(chosen, 0.0)
            self._assembly.state.follow_volume(self._mask(chosen))
        self._switch(chosen & self._convex)
        self.converged[chosen], self.failed[chosen] = False, False
        state = self._assembly.state
        self._assembly.evaluate(self._mask(chosen), state.u, self._cg.solution)
        self._check_convergence(chosen & ~self._predicting)

    def sweep(
        self, running: np.ndarray, meanwhile: Callable[[Callable[[], bool]], None] | None = None
    ) -> None:
        """Run an iteration of the environments (B,) under way; `meanwhile` as in `solve`."""
        assembly, state = self._assembly, self._assembly.state
        active, predicting = self._mask(running), running & self._predicting
        if self._friction:
            slow = running & (self.iterations < self._relaxed_until)
            for some, fraction in (running & ~slow, 1.0), (slow, RELAX_SHARE):
                if some.any():
                    assembly.relax_limit(self._mask(some), fraction)
            if slow.any():
                assembly.evaluate_contact(self._mask(slow), state.u, self._cg.solution)
        assembly.linearise(active, state.u, self._damping)
        if predicting.any():
            assembly.push(self._mask(predicting), state.travel(predicting))
        before = self.residual.copy()
        accuracy = np.clip(0.3 * before, ACCURACY_LEAST, ACCURACY)
        accuracy[predicting] = PREDICTION
        self._cg.solve(
            running,
            assembly.residual,
            np.where(running, accuracy, 1.0),
            assembly.numerics.cg_max,
            meanwhile,
        )
        state.set_tip(predicting)
        assembly.depart(active, self._start, self._whole, self._cg.solution)
        used, slope, concave = self._cg.status()
        used = np.where(running, used, 0)
        self.cg += used
        assembly.preconditioner.learn(used, accuracy)
        self.iterations[running] += 1
        walked, length = self._search(running, predicting, slope)
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
        alternates = running & (self.residual > RELAX_ABOVE * before)
        alternates &= self.iterations >= np.maximum(self._relaxed_until, RELAX_AFTER)
        self._relaxed_for[alternates] += RELAX_FOR
        self._relaxed_until[alternates] = (self.iterations + self._relaxed_for)[alternates]
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
            assembly.evaluate_contact(active, state.u, self._cg.solution, settle=True)
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

    def _search(self, running, predicting, slope) -> tuple[np.ndarray, np.ndarray]:
        """Search along the direction, whose end is the last evaluated state.

        A prediction is taken in full, or not at all if it leads to an invalid state.

        Returns:
            Success (B,) and step length (B,).
        """
        assembly, state = self._assembly, self._assembly.state
        direction = self._cg.solution
        length = np.ones(assembly.environments)
        open_ = running.copy()
        for trial in range(TRIALS):
            if trial:
                trying = self._mask(open_)
                axpy(trying, self._lengths(length), self._start, direction, state.u)
                assembly.evaluate(trying, state.u, direction)
            sums = assembly.sums
            with np.errstate(invalid="ignore", divide="ignore"):
                finite = np.isfinite(sums["square"]) & np.isfinite(sums["slope"])
                is_valid = finite & (sums["det"] > DET_TRIAL)
                good = is_valid & (sums["slope"] <= 0.5 * np.abs(slope))
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

    def _lengths(self, length: np.ndarray):
        """Return lengths (B,) as an array for the kernels; most steps are whole."""
        assembly = self._assembly
        if (length == 1.0).all():
            return self._whole
        return array_of(length, assembly.real, assembly.real, assembly.device)

    def work(self, chosen: np.ndarray, duration: np.ndarray) -> np.ndarray:
        """Return the indenter's work over the step that led to the current state (B,) [E T^3].

        Work on the skin is integrated from both ends of the step. For a long step the energy that
        the body takes up half-way is added (Simpson's rule). The state of the chosen environments,
        whose step has converged, does not change; durations are in [s].
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


# Preconditioned conjugate gradients on all environments at once, each stopping independently.
#
# A row holds the index of an environment, or -1. On a CPU, and for a single environment, a solve is
# one graph with a loop, and one array of `SCALARS` is read back at the end. For more of
# them on a GPU, the beginning and the iterations, of five kernels each, are graphs, recorded once
# per number of launched rows, and the indices of running environments are read after every `LOOK`
# iterations: when half of the environments have finished, the others move together and half as many
# rows are launched, since idle threads take time as well. Dot products are float64 whichever
# precision the vectors have.

# Iterations between checks by the host for running environments; one with coarser grids takes much
# longer than a check. Iterations between those of a graph on a GPU, without coarser grids.
LOOK, LOOK_GRIDS, LOOK_GRAPH = 8, 2, 4

# Mark that replaces the target accuracy: stop here, the tangent is not convex.
CONCAVE = 1e300
# Scalars per environment: r.z, target of r.r, step length, direction update (beta), slope, number
# of iterations.
SCALARS = 6


@functools.cache
def _cg_kernels(real, lanes: int):
    """Return the kernels for one precision; `lanes` threads add up a sum: 1, or a whole block."""
    vec3 = vector_of(real)

    @wp.func
    def total(sums: wp.array3d(dtype=wp.float64), env: int, lane: int, which: int):
        """Return a dot product from its partial sums."""
        whole = wp.float64(0.0)
        for part in range(lane, sums.shape[1], lanes):
            whole += sums[env, part, which]
        if wp.static(lanes > 1):
            whole = wp.tile_sum(wp.tile(whole))[0]
        return whole

    batched = kernel(group=f"sim.fem.newton.{real.__name__}.{lanes}", block=LANES)

    @batched
    def start(
        # In:
        which: wp.array(dtype=wp.int32),
        residual: wp.array2d(dtype=vec3),
        # Out:
        solution_out: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec3),
        p_out: wp.array2d(dtype=vec3),
        product_out: wp.array2d(dtype=vec3),
        scalars_out: wp.array2d(dtype=wp.float64),
        goes_on_out: wp.array(dtype=wp.int32),
    ):
        row, n = wp.tid()
        if row == 0 and n == 0:
            goes_on_out[0] = 0
        env = which[row]
        if env < 0:
            return
        if n == 0:
            for column in range(SCALARS):
                scalars_out[env, column] = wp.float64(0.0)
        solution_out[env, n] = vec3()
        p_out[env, n] = vec3()
        product_out[env, n] = vec3()
        r_out[env, n] = residual[env, n]

    @batched
    def compare(
        # In: True at the start of solves
        first: bool,
        sums: wp.array3d(dtype=wp.float64),
        accuracy: wp.array(dtype=wp.float64),
        most: int,
        # In and out:
        which: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
        # Out: 1 if any environment goes on
        goes_on_out: wp.array(dtype=wp.int32),
    ):
        """End solves by their residual."""
        row, lane = wp.tid()
        env = which[row]
        if env < 0:
            return
        rz = total(sums, env, lane, 0)
        rr = total(sums, env, lane, 1)
        if lane == 0:
            ended = rr == wp.float64(0.0)
            if first:
                scalars_out[env, 1] = rr * accuracy[env] * accuracy[env]
            else:
                scalars_out[env, 3] = rz / scalars_out[env, 0]
                ended = not (rr > scalars_out[env, 1])
            scalars_out[env, 0] = rz
            if not ended and not (rz > wp.float64(0.0)):
                # Nor is the preconditioner positive definite, if it is made from such a tangent.
                scalars_out[env, 1] = wp.float64(CONCAVE)
                ended = True
            if ended or scalars_out[env, 5] >= wp.float64(most):
                which[row] = -1
            else:
                goes_on_out[0] = 1

    @batched
    def step_length(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        # In and out:
        which: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
        # Out: 0, until an environment goes on
        goes_on_out: wp.array(dtype=wp.int32),
    ):
        row, lane = wp.tid()
        if row == 0 and lane == 0:
            goes_on_out[0] = 0
        env = which[row]
        if env < 0:
            return
        curvature = total(sums, env, lane, 0)
        if lane == 0:
            if curvature > wp.float64(0.0):
                scalars_out[env, 2] = scalars_out[env, 0] / curvature
            else:
                # Not convex along p: keep the solution so far; in the first iteration step along p.
                scalars_out[env, 2] = wp.float64(0.0)
                if scalars_out[env, 5] == wp.float64(0.0):
                    scalars_out[env, 2] = wp.float64(1.0)
                scalars_out[env, 1] = wp.float64(CONCAVE)
            # The right-hand side times p is r.z: all later residuals are orthogonal to it.
            scalars_out[env, 4] = scalars_out[env, 4] - scalars_out[env, 2] * scalars_out[env, 0]
            scalars_out[env, 5] = scalars_out[env, 5] + wp.float64(1.0)

    @batched
    def turn(
        # In:
        which: wp.array(dtype=wp.int32),
        scalars: wp.array2d(dtype=wp.float64),
        z: wp.array2d(dtype=vec3),
        # In and out:
        p_out: wp.array2d(dtype=vec3),
    ):
        row, n = wp.tid()
        env = which[row]
        if env < 0:
            return
        p_out[env, n] = z[env, n] + p_out[env, n] * real(scalars[env, 3])

    return start, step_length, compare, turn


class ConjugateGradient:
    """Solver of tangent x = residual for B environments of N nodes; it owns its vectors.

    The tangent is a `BlockMatrix`, or what has its `product` and `parts`; the preconditioner a
    `Multigrid`, or what has its `choose`, `advance`, `grids` and `parts`. `gather` launches fewer
    rows as environments end, by default for more than one on a GPU; `record` makes iterations a
    graph, in which both may only launch kernels.
    """

    def __init__(
        self,
        real,
        environments: int,
        nodes: int,
        device: str,
        matrix,
        preconditioner,
        *,
        gather: bool | None = None,
        record: bool = True,
    ) -> None:
        vec3 = vector_of(real)
        shape = (environments, nodes)
        self._device = wp.get_device(device)
        self._matrix, self._preconditioner = matrix, preconditioner
        self._shape = shape
        # Vectors (B, N); `solution` is the result.
        self.solution, self._r, self._p, self._z, self._product = (
            wp.zeros(shape, dtype=vec3, device=device) for _ in range(5)
        )
        parts = environments, matrix.parts, 1
        self._along = wp.zeros(parts, dtype=wp.float64, device=device)
        parts = environments, preconditioner.parts, 2
        self._sums = wp.zeros(parts, dtype=wp.float64, device=device)
        self._which = self._all_rows = wp.zeros(environments, dtype=wp.int32, device=device)
        self._accuracy = wp.zeros(environments, dtype=wp.float64, device=device)
        self._scalars = wp.zeros((environments, SCALARS), dtype=wp.float64, device=device)
        self._goes_on = wp.zeros(1, dtype=wp.int32, device=device)
        self._graphs = Graphs(self._device, record=record)
        if gather is None:
            loops = environments == 1 and wp.is_conditional_graph_supported()
            gather = self._device.is_cuda and not loops
        self._gathers = gather
        self._lanes = LANES if self._device.is_cuda else 1
        self._kernels = _cg_kernels(real, self._lanes)
        self._launched = wp.Event(self._device) if self._device.is_cuda else None

    def solve(
        self,
        chosen: np.ndarray,
        residual,
        accuracy,
        most: int,
        meanwhile: Callable[[Callable[[], bool]], None] | None = None,
    ) -> None:
        """Fill `solution` of the chosen environments (B,); `status` tells how.

        The target of |r| / |residual| is `accuracy`, float64 NumPy (B,), in at most `most`
        iterations. `meanwhile` is called when a GPU has work to do, with a function that is true
        while it has.
        """
        running = np.flatnonzero(chosen)
        self._gather(running, renew=True)
        self._accuracy.assign(accuracy)
        grids = self._preconditioner.choose(running)
        key = len(self._which), grids
        self._graphs.repeat(self._begin, residual, most, key=key)
        while len(running):
            if self._gathers:
                look = LOOK if grids == 1 else LOOK_GRIDS
                self._graphs.repeat(self._iterate, look, most, key=key)
            if meanwhile is not None and self._launched is not None:
                wp.record_event(self._launched)
                meanwhile(lambda: not self._launched.is_complete)
            if not self._gathers:
                break
            rows = self._which.numpy()
            running = rows[rows >= 0]
            if len(running):
                self._gather(running)
                grids = self._preconditioner.choose(running)
                key = len(self._which), grids

    def status(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends of the last solve of each environment, once it is over (B,).

        Its iterations, -(right-hand side) . solution, and True if it has met a direction along
        which the tangent is not convex.
        """
        scalars = self._scalars.numpy().copy()
        return scalars[:, 5].astype(int), scalars[:, 4], scalars[:, 1] >= CONCAVE

    def _gather(self, running: np.ndarray, *, renew: bool = False) -> None:
        """Launch at most twice as many rows as `running`; `renew` them if they have changed."""
        rows = self._shape[0]
        while self._gathers and rows > 1 and len(running) <= rows // 2:
            rows //= 2
        if renew or rows < len(self._which):
            rows_now = np.full(rows, -1, np.int32)
            rows_now[: len(running)] = running
            self._which = self._all_rows[:rows]
            self._which.assign(rows_now)

    def _begin(self, residual, most: int) -> None:
        start = self._kernels[0]
        outputs = self.solution, self._r, self._p, self._product, self._scalars, self._goes_on
        self._launch(start, self._shape[1], [self._which, residual], list(outputs))
        self._step(most, first=True)
        if not self._gathers:
            often = self._preconditioner.grids > 1 or self._device.is_cpu
            times = 1 if often else LOOK_GRAPH
            wp.capture_while(self._goes_on, self._iterate, times=times, most=most)

    def _iterate(self, times: int, most: int) -> None:
        for _time in range(times):
            self._matrix.product(self._which, self._p, self._product, self._along)
            outputs = [self._which, self._scalars, self._goes_on]
            self._launch(self._kernels[1], self._lanes, [self._along], outputs)
            self._step(most, first=False)

    def _step(self, most: int, *, first: bool) -> None:
        """Step along the search direction, end solves, and turn to the next direction."""
        along, vectors = (self._p, self._product), (self.solution, self._r, self._z)
        self._preconditioner.advance(self._which, self._scalars, along, vectors, self._sums)
        _start, _step_length, compare, turn = self._kernels
        inputs, outputs = [first, self._sums, self._accuracy, most], [self._which, self._scalars]
        self._launch(compare, self._lanes, inputs, [*outputs, self._goes_on])
        inputs = [self._which, self._scalars, self._z]
        self._launch(turn, self._shape[1], inputs, [self._p])

    def _launch(self, one, width: int, inputs, outputs) -> None:
        rows = len(self._which), width
        wp.launch(one, rows, inputs, outputs, device=self._device, block_dim=LANES)
