# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Preconditioned conjugate gradients on all environments at once, each stopping independently.

The only data read back from the device are the indices of running environments, every `LOOK`
iterations, and one array of `SCALARS` at the end. The beginning and the iterations in between, of
five kernels each, are graphs, recorded once per number of launched rows. A row holds the index of
an environment, or -1. When half of the environments have finished, the others move together and
half as many rows are launched, since idle threads take time as well. Dot products are float64
whichever precision the vectors have.
"""

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from sim.fem.arrays import Graphs
from sim.fem.balance import LANES
from sim.scalars import vector_of

# Iterations between checks for running environments: free on the CPU, a stop on a GPU, where one
# with coarser grids takes much longer than the check.
LOOK, LOOK_GRIDS = {"cpu": 1, "cuda": 8}, {"cpu": 1, "cuda": 2}

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

    @wp.kernel(enable_backward=False, module="unique")
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
    ):
        row, n = wp.tid()
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

    def comparison(first: bool):
        """Return the kernel that ends solves by their residual, at the start or later."""

        @wp.kernel(enable_backward=False, module="unique")
        def compare(
            # In:
            sums: wp.array3d(dtype=wp.float64),
            accuracy: wp.array(dtype=wp.float64),
            # In and out:
            which: wp.array(dtype=wp.int32),
            scalars_out: wp.array2d(dtype=wp.float64),
        ):
            row, lane = wp.tid()
            env = which[row]
            if env < 0:
                return
            rz = total(sums, env, lane, 0)
            rr = total(sums, env, lane, 1)
            if lane == 0:
                ended = rr == wp.float64(0.0)
                if wp.static(first):
                    scalars_out[env, 1] = rr * accuracy[env] * accuracy[env]
                else:
                    scalars_out[env, 3] = rz / scalars_out[env, 0]
                    ended = not (rr > scalars_out[env, 1])
                scalars_out[env, 0] = rz
                if ended:
                    which[row] = -1
                elif not (rz > wp.float64(0.0)):
                    # Nor is the preconditioner positive definite, if it is made from such a
                    # tangent.
                    scalars_out[env, 1] = wp.float64(CONCAVE)
                    which[row] = -1

        return compare

    @wp.kernel(enable_backward=False, module="unique")
    def step_length(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        # In and out:
        which: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
    ):
        row, lane = wp.tid()
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

    @wp.kernel(enable_backward=False, module="unique")
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

    return start, comparison(first=True), step_length, comparison(first=False), turn


class ConjugateGradient:
    """Solver of tangent x = residual for B environments of N nodes; it owns its vectors.

    Args:
        real: Warp's scalar type.
        environments: B.
        nodes: N.
        device: Device of the vectors.
        matrix: Tangent: `product(which, p, product, sums)` writes tangent p and the partial sums
            of p . tangent p, (B, `matrix.parts`, 1), for the environments `which` (R,).
        preconditioner: `choose(running)` sets and returns the number of `grids` that the running
            environments, by index, need; `advance` steps along p and writes z and the partial sums
            of r.z and r.r, (B, `preconditioner.parts`, 2).
        gather: Launch fewer rows as environments end; by default only on a GPU.
        record: Record iterations as a graph; both may only launch kernels then.
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
        self._real = real
        self._device = wp.get_device(device)
        self._matrix, self._preconditioner = matrix, preconditioner
        self._shape = shape
        self.solution = wp.zeros(shape, dtype=vec3, device=device)
        """Solution (B, N)."""
        self._r = wp.zeros(shape, dtype=vec3, device=device)
        self._p = wp.zeros(shape, dtype=vec3, device=device)
        self._z = wp.zeros(shape, dtype=vec3, device=device)
        self._product = wp.zeros(shape, dtype=vec3, device=device)
        parts = environments, matrix.parts, 1
        self._along = wp.zeros(parts, dtype=wp.float64, device=device)
        parts = environments, preconditioner.parts, 2
        self._sums = wp.zeros(parts, dtype=wp.float64, device=device)
        self._which = self._all_rows = wp.zeros(environments, dtype=wp.int32, device=device)
        self._accuracy = wp.zeros(environments, dtype=wp.float64, device=device)
        self._scalars = wp.zeros((environments, SCALARS), dtype=wp.float64, device=device)
        self._ended = np.zeros((environments, SCALARS))
        self._graphs = Graphs(self._device, record=record)
        self._gathers = self._device.is_cuda if gather is None else gather
        self._lanes = LANES if self._device.is_cuda else 1
        self._launched = wp.Event(self._device) if self._device.is_cuda else None

    def solve(
        self,
        chosen: np.ndarray,
        residual,
        accuracy,
        most: int,
        meanwhile: Callable[[Callable[[], bool]], None] | None = None,
    ) -> np.ndarray:
        """Fill `solution` of the chosen environments and return their numbers of iterations (B,).

        Args:
            chosen: True for the environments to solve (B,).
            residual: Right-hand side (B, N).
            accuracy: Target of |r| / |residual|, float64 NumPy (B,).
            most: Most iterations; the graph in which this is reached is completed.
            meanwhile: Called when a GPU has work to do, with a function that is true while it has.
        """
        running = np.flatnonzero(chosen)
        self._gather(running, renew=True)
        self._accuracy.assign(accuracy)
        grids = self._preconditioner.choose(running)
        begins = "begin", residual.ptr, len(self._which), grids
        with self._graphs.recorded(begins) as done_by_graph:
            if not done_by_graph:
                self._begin(residual)
        kind, done = "cuda" if self._device.is_cuda else "cpu", 0
        while len(running) and done < most:
            look = (LOOK if grids == 1 else LOOK_GRIDS)[kind]
            goes_on = "go on", len(self._which), grids
            with self._graphs.recorded(goes_on) as done_by_graph:
                if not done_by_graph:
                    self._iterate(look)
            if meanwhile is not None and self._launched is not None:
                wp.record_event(self._launched)
                meanwhile(lambda: not self._launched.is_complete)
            done += look
            rows = self._which.numpy()
            running = rows[rows >= 0]
            if len(running):
                self._gather(running)
                grids = self._preconditioner.choose(running)
        self._ended = self._scalars.numpy().copy()
        return np.where(chosen, self._ended[:, 5], 0.0).astype(int)

    def status(self) -> tuple[np.ndarray, np.ndarray]:
        """Return -(right-hand side) . solution, and True for solves that ended concave (B,).

        Those met a direction along which the tangent is not convex. It is that of the last solve of
        each environment.
        """
        return self._ended[:, 4], self._ended[:, 1] >= CONCAVE

    def _gather(self, running: np.ndarray, *, renew: bool = False) -> None:
        """Launch at most twice as many rows as are running, if rows are gathered at all.

        `running` are indices of environments; `renew` them if there are others than before.
        """
        rows = self._shape[0]
        while self._gathers and rows > 1 and len(running) <= rows // 2:
            rows //= 2
        if renew or rows < len(self._which):
            found = np.full(rows, -1, np.int32)
            found[: len(running)] = running
            self._which = self._all_rows[:rows]
            self._which.assign(found)

    def _begin(self, residual) -> None:
        start, begin, _step_length, _change, turn = _cg_kernels(self._real, self._lanes)
        vectors = [self.solution, self._r, self._p, self._product]
        self._launch(start, [residual], [*vectors, self._scalars])
        self._advance()
        self._total(begin, [self._sums, self._accuracy], [self._which, self._scalars])
        self._launch(turn, [self._scalars, self._z], [self._p])

    def _iterate(self, times: int) -> None:
        _start, _begin, step_length, change, turn = _cg_kernels(self._real, self._lanes)
        for _time in range(times):
            self._matrix.product(self._which, self._p, self._product, self._along)
            self._total(step_length, [self._along], [self._which, self._scalars])
            self._advance()
            self._total(change, [self._sums, self._accuracy], [self._which, self._scalars])
            self._launch(turn, [self._scalars, self._z], [self._p])

    def _advance(self) -> None:
        self._preconditioner.advance(
            self._which,
            self._scalars,
            (self._p, self._product),
            (self.solution, self._r, self._z),
            self._sums,
        )

    def _total(self, kernel, inputs, outputs) -> None:
        wp.launch(
            kernel,
            dim=(len(self._which), self._lanes),
            inputs=inputs,
            outputs=outputs,
            device=self._device,
            block_dim=LANES,
        )

    def _launch(self, kernel, inputs, outputs) -> None:
        wp.launch(
            kernel,
            dim=(len(self._which), self._shape[1]),
            inputs=[self._which, *inputs],
            outputs=outputs,
            device=self._device,
        )
