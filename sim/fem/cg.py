# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Preconditioned conjugate gradients on all environments at once, each stopping on its own.

No number leaves the device but the count of environments still running, looked at every
`LOOK` iterations. Dot products are float64 whatever the precision of the vectors.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.nodes import RUN
from sim.fem.scalars import matrix_of, vector_of

LOOK = {"cpu": 1, "cuda": 16}
"""Iterations between looks at who is still running: free on the CPU, a stop on a GPU."""

CONCAVE = 1e300
"""Mark in place of the accuracy to reach: stop here, the tangent is not convex."""


@functools.cache
def _kernels(real):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)

    @wp.func
    def products(sums: wp.array3d(dtype=wp.float64), env: int):
        """r.z and r.r of one environment, from the shares of its runs."""
        rz = wp.float64(0.0)
        rr = wp.float64(0.0)
        for run in range(sums.shape[1]):
            rz += sums[env, run, 1]
            rr += sums[env, run, 2]
        return rz, rr

    @wp.kernel(enable_backward=False, module="unique")
    def start(
        # In:
        active: wp.array(dtype=wp.int32),
        residual: wp.array2d(dtype=vec3),
        inverse: wp.array2d(dtype=mat33),
        # Out:
        solution_out: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec3),
        p_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        env, run = wp.tid()
        if active[env] == 0:
            return
        rz = wp.float64(0.0)
        rr = wp.float64(0.0)
        for n in range(run * RUN, wp.min((run + 1) * RUN, residual.shape[1])):
            r = residual[env, n]
            z = inverse[env, n] * r
            solution_out[env, n] = vec3()
            r_out[env, n] = r
            p_out[env, n] = z
            rz += wp.float64(wp.dot(r, z))
            rr += wp.float64(wp.dot(r, r))
        sums_out[env, run, 1] = rz
        sums_out[env, run, 2] = rr

    @wp.kernel(enable_backward=False, module="unique")
    def begin(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        accuracy: wp.array(dtype=wp.float64),
        # In and out: rz, rr to reach, step, change of direction, by environment
        active: wp.array(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
    ):
        env = wp.tid()
        count_out[env] = 0
        if active[env] == 0:
            return
        rz, rr = products(sums, env)
        scalars_out[env, 0] = rz
        scalars_out[env, 1] = rr * accuracy[env] * accuracy[env]
        if rr == wp.float64(0.0):
            active[env] = 0

    @wp.kernel(enable_backward=False, module="unique")
    def step_length(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        # In and out:
        active: wp.array(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
    ):
        env = wp.tid()
        if active[env] == 0:
            return
        curvature = wp.float64(0.0)
        for run in range(sums.shape[1]):
            curvature += sums[env, run, 0]
        if curvature > wp.float64(0.0):
            scalars_out[env, 2] = scalars_out[env, 0] / curvature
        else:
            # Not convex along p: keep what was found; at the very start go along p itself.
            scalars_out[env, 2] = wp.float64(0.0)
            if count_out[env] == 0:
                scalars_out[env, 2] = wp.float64(1.0)
            scalars_out[env, 1] = wp.float64(CONCAVE)
        count_out[env] = count_out[env] + 1

    @wp.kernel(enable_backward=False, module="unique")
    def advance(
        # In:
        active: wp.array(dtype=wp.int32),
        scalars: wp.array2d(dtype=wp.float64),
        inverse: wp.array2d(dtype=mat33),
        p: wp.array2d(dtype=vec3),
        product: wp.array2d(dtype=vec3),
        # In and out:
        solution_out: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec3),
        # Out:
        z_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        env, run = wp.tid()
        if active[env] == 0:
            return
        step = real(scalars[env, 2])
        rz = wp.float64(0.0)
        rr = wp.float64(0.0)
        for n in range(run * RUN, wp.min((run + 1) * RUN, p.shape[1])):
            solution_out[env, n] = solution_out[env, n] + p[env, n] * step
            r = r_out[env, n] - product[env, n] * step
            z = inverse[env, n] * r
            r_out[env, n] = r
            z_out[env, n] = z
            rz += wp.float64(wp.dot(r, z))
            rr += wp.float64(wp.dot(r, r))
        sums_out[env, run, 1] = rz
        sums_out[env, run, 2] = rr

    @wp.kernel(enable_backward=False, module="unique")
    def change(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        # In and out:
        active: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
    ):
        env = wp.tid()
        if active[env] == 0:
            return
        rz, rr = products(sums, env)
        scalars_out[env, 3] = rz / scalars_out[env, 0]
        scalars_out[env, 0] = rz
        if not (rr > scalars_out[env, 1]):
            active[env] = 0

    @wp.kernel(enable_backward=False, module="unique")
    def turn(
        # In:
        active: wp.array(dtype=wp.int32),
        scalars: wp.array2d(dtype=wp.float64),
        z: wp.array2d(dtype=vec3),
        # In and out:
        p_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        p_out[env, n] = z[env, n] + p_out[env, n] * real(scalars[env, 3])

    return start, begin, step_length, advance, change, turn


class ConjugateGradient:
    """Solves tangent x = residual for B environments of N nodes; owns its vectors.

    `apply(active, p, product, sums)` must write tangent p into `product` and the partial sums of
    p . product into `sums[..., 0]`, for active environments.
    """

    def __init__(self, real, environments: int, nodes: int, device: str) -> None:
        vec3 = vector_of(real)
        shape = (environments, nodes)
        self._real = real
        self._device = wp.get_device(device)
        self._runs = -(-nodes // RUN)
        self._shape = shape
        self.solution = wp.zeros(shape, dtype=vec3, device=device)
        """Where the answer is (B, N)."""
        self._r = wp.zeros(shape, dtype=vec3, device=device)
        self._p = wp.zeros(shape, dtype=vec3, device=device)
        self._z = wp.zeros(shape, dtype=vec3, device=device)
        self._product = wp.zeros(shape, dtype=vec3, device=device)
        self._sums = wp.zeros((*shape[:1], self._runs, 3), dtype=wp.float64, device=device)
        self._active = wp.zeros(environments, dtype=wp.int32, device=device)
        self._count = wp.zeros(environments, dtype=wp.int32, device=device)
        self._accuracy = wp.zeros(environments, dtype=wp.float64, device=device)
        self._scalars = wp.zeros((environments, 4), dtype=wp.float64, device=device)

    def solve(self, active, residual, inverse, apply, accuracy, most: int) -> np.ndarray:
        """Fill `solution` of active environments; the iterations of each (B,).

        Args:
            active: Which environments, int32 (B,); not changed.
            residual: Right-hand side (B, N).
            inverse: Inverse diagonal blocks (B, N), zero where a node is held.
            apply: The tangent, see the class.
            accuracy: |r| / |residual| to reach, float64 NumPy (B,).
            most: Iterations at most.
        """
        start, begin, step_length, advance, change, turn = _kernels(self._real)
        environments = self._shape[0]
        runs = (environments, self._runs)
        device = self._device
        wp.copy(self._active, active)
        self._accuracy.assign(accuracy)
        wp.launch(
            start,
            dim=runs,
            inputs=[self._active, residual, inverse],
            outputs=[self.solution, self._r, self._p, self._sums],
            device=device,
        )
        wp.launch(
            begin,
            dim=environments,
            inputs=[self._sums, self._accuracy],
            outputs=[self._active, self._count, self._scalars],
            device=device,
        )
        look = LOOK["cuda" if device.is_cuda else "cpu"]
        for iteration in range(most):
            if iteration % look == 0 and not self._active.numpy().any():
                break
            apply(self._active, self._p, self._product, self._sums)
            wp.launch(
                step_length,
                dim=environments,
                inputs=[self._sums],
                outputs=[self._active, self._count, self._scalars],
                device=device,
            )
            wp.launch(
                advance,
                dim=runs,
                inputs=[self._active, self._scalars, inverse, self._p, self._product],
                outputs=[self.solution, self._r, self._z, self._sums],
                device=device,
            )
            wp.launch(
                change,
                dim=environments,
                inputs=[self._sums],
                outputs=[self._active, self._scalars],
                device=device,
            )
            wp.launch(
                turn,
                dim=self._shape,
                inputs=[self._active, self._scalars, self._z],
                outputs=[self._p],
                device=device,
            )
        return self._count.numpy().copy()

    def concave(self) -> np.ndarray:
        """Where the last solve met a direction along which the tangent is not convex (B,)."""
        return self._scalars.numpy()[:, 1] >= CONCAVE
