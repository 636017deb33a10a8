# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Preconditioned conjugate gradients on all environments at once, each stopping on its own.

No number leaves the device but which environments are still running, looked at every `LOOK`
iterations; the iterations between are one graph, recorded once for as many rows as are launched:
five kernels each, which Python need not launch one by one. Rows hold the number of an environment,
or -1: when half of them are through, the others move together and half as many are launched, since
threads that have nothing to do take time as well. Dot products are float64 whatever the precision
of the vectors.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.scalars import vector_of

LOOK = {"cpu": 1, "cuda": 8}
"""Iterations between looks at who is still running: free on the CPU, a stop on a GPU."""

CONCAVE = 1e300
"""Mark in place of the accuracy to reach: stop here, the tangent is not convex."""
LANES = 128
"""Threads of a GPU that add up the shares of one environment's sum."""
SCALARS = 5
"""Numbers of each environment: r.z, r.r to reach, step, change of direction, slope."""


@functools.cache
def _kernels(real, lanes: int):
    """Kernels for one precision; `lanes` threads add up a sum: 1, or a whole block of them."""
    vec3 = vector_of(real)

    @wp.func
    def total(sums: wp.array3d(dtype=wp.float64), env: int, lane: int, which: int):
        """The whole of a dot product, from its shares."""
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
    ):
        row, n = wp.tid()
        env = which[row]
        if env < 0:
            return
        solution_out[env, n] = vec3()
        p_out[env, n] = vec3()
        product_out[env, n] = vec3()
        r_out[env, n] = residual[env, n]

    @wp.kernel(enable_backward=False, module="unique")
    def begin(
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
            scalars_out[env, 0] = rz
            scalars_out[env, 1] = rr * accuracy[env] * accuracy[env]
            scalars_out[env, 3] = wp.float64(0.0)
            scalars_out[env, 4] = wp.float64(0.0)
            if rr == wp.float64(0.0):
                which[row] = -1

    @wp.kernel(enable_backward=False, module="unique")
    def step_length(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        # In and out:
        which: wp.array(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
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
                # Not convex along p: keep what was found; at the very start go along p itself.
                scalars_out[env, 2] = wp.float64(0.0)
                if count_out[env] == 0:
                    scalars_out[env, 2] = wp.float64(1.0)
                scalars_out[env, 1] = wp.float64(CONCAVE)
            # The right-hand side times p is r.z: every later residual is at right angles to it.
            scalars_out[env, 4] = scalars_out[env, 4] - scalars_out[env, 2] * scalars_out[env, 0]
            count_out[env] = count_out[env] + 1

    @wp.kernel(enable_backward=False, module="unique")
    def change(
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
        rz = total(sums, env, lane, 0)
        rr = total(sums, env, lane, 1)
        if lane == 0:
            scalars_out[env, 3] = rz / scalars_out[env, 0]
            scalars_out[env, 0] = rz
            if not (rr > scalars_out[env, 1]):
                which[row] = -1

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

    return start, begin, step_length, change, turn


class ConjugateGradient:
    """Solves tangent x = residual for B environments of N nodes; owns its vectors.

    Args:
        real: Warp's scalar type.
        environments: How many, B.
        nodes: How many, N.
        device: Where.
        stencil: The tangent: `product(which, p, product, sums)` writes tangent p and the shares of
            p . tangent p, (B, `stencil.parts`, 1), of the environments `which` (R,) names.
        columns: The preconditioner: `advance` goes a step along p and writes z and the shares of
            r.z and r.r, (B, `columns.parts`, 2).
        gather: Whether fewer rows are launched as environments end. On a GPU, when not said.
        record: Whether iterations are a graph: `stencil` and `columns` only launch kernels.
    """

    def __init__(
        self,
        real,
        environments: int,
        nodes: int,
        device: str,
        stencil,
        columns,
        *,
        gather: bool | None = None,
        record: bool = True,
    ) -> None:
        vec3 = vector_of(real)
        shape = (environments, nodes)
        self._real = real
        self._device = wp.get_device(device)
        self._stencil, self._columns = stencil, columns
        self._shape = shape
        self.solution = wp.zeros(shape, dtype=vec3, device=device)
        """Where the answer is (B, N)."""
        self._r = wp.zeros(shape, dtype=vec3, device=device)
        self._p = wp.zeros(shape, dtype=vec3, device=device)
        self._z = wp.zeros(shape, dtype=vec3, device=device)
        self._product = wp.zeros(shape, dtype=vec3, device=device)
        parts = environments, stencil.parts, 1
        self._along = wp.zeros(parts, dtype=wp.float64, device=device)
        parts = environments, columns.parts, 2
        self._sums = wp.zeros(parts, dtype=wp.float64, device=device)
        self._which = self._all_rows = wp.zeros(environments, dtype=wp.int32, device=device)
        self._count = wp.zeros(environments, dtype=wp.int32, device=device)
        self._accuracy = wp.zeros(environments, dtype=wp.float64, device=device)
        self._scalars = wp.zeros((environments, SCALARS), dtype=wp.float64, device=device)
        self._records, self._graphs = record, {}
        self._gathers = self._device.is_cuda if gather is None else gather
        self._lanes = LANES if self._device.is_cuda else 1

    def solve(self, active, residual, accuracy, most: int) -> np.ndarray:
        """Fill `solution` of active environments; the iterations of each (B,).

        Args:
            active: Which environments, int32 (B,); not changed.
            residual: Right-hand side (B, N).
            accuracy: |r| / |residual| to reach, float64 NumPy (B,).
            most: Iterations at most; the graph that they end in is finished.
        """
        start, begin, _step_length, _change, turn = _kernels(self._real, self._lanes)
        self._gather(np.flatnonzero(active.numpy()), anew=True)
        self._accuracy.assign(accuracy)
        self._count.zero_()
        self._scalars.zero_()
        self._launch(start, [residual], [self.solution, self._r, self._p, self._product])
        self._advance()
        self._total(begin, [self._sums, self._accuracy], [self._which, self._scalars])
        self._launch(turn, [self._scalars, self._z], [self._p])
        look = LOOK["cuda" if self._device.is_cuda else "cpu"]
        for _iteration in range(0, most, look):
            rows = self._which.numpy()
            if (rows < 0).all():
                break
            self._gather(rows[rows >= 0])
            self._iterate(look)
        return self._count.numpy().copy()

    def verdict(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the last solve (B,): -(right-hand side) . solution; whether it ended concave.

        Concave: it met a direction along which the tangent is not convex.
        """
        scalars = self._scalars.numpy()
        return scalars[:, 4].copy(), scalars[:, 1] >= CONCAVE

    def _gather(self, running: np.ndarray, *, anew: bool = False) -> None:
        """Launch at most twice as many rows as are running, if rows are gathered at all.

        Args:
            running: Numbers of environments.
            anew: They are not those of before.
        """
        rows = self._shape[0]
        while self._gathers and rows > 1 and len(running) <= rows // 2:
            rows //= 2
        if anew or rows < len(self._which):
            found = np.full(rows, -1, np.int32)
            found[: len(running)] = running
            self._which = self._all_rows[:rows]
            self._which.assign(found)

    def _iterate(self, times: int) -> None:
        if not self._records:
            for _time in range(times):
                self._once()
            return
        rows = len(self._which)
        if rows not in self._graphs:
            self._once()  # compiles what is not compiled, which a recording must not
            with wp.ScopedCapture(self._device) as capture:
                for _time in range(times):
                    self._once()
            self._graphs[rows] = capture.graph
            return
        wp.capture_launch(self._graphs[rows])

    def _once(self) -> None:
        _start, _begin, step_length, change, turn = _kernels(self._real, self._lanes)
        self._stencil.product(self._which, self._p, self._product, self._along)
        self._total(step_length, [self._along], [self._which, self._count, self._scalars])
        self._advance()
        self._total(change, [self._sums], [self._which, self._scalars])
        self._launch(turn, [self._scalars, self._z], [self._p])

    def _advance(self) -> None:
        self._columns.advance(
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
