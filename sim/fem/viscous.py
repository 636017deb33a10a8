# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Prony branches at the Gauss points: what they remember, and how a step changes it.

Simo & Hughes, Computational Inelasticity (1998), section 10.3: the stress of branch i after a step
dt is h = exp(-dt/time) h_old + ratio a (S - S_old) with a = (1 - exp(-dt/time)) time / dt, S the
second Piola-Kirchhoff stress at rest. So within a step the stress is S (1 + sum ratio a) + history,
where history = sum(exp(-dt/time) h_old) - sum(ratio a) S_old does not change: that is all the
element kernels see. The pressure of an element relaxes in the same way.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.element import GAUSS_POINTS, mode_functions, strain_functions
from sim.fem.scalars import matrix_of, numpy_of, vector_of


@functools.cache
def _kernels(real):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, _scatter = mode_functions(real)
    strain, cofactor, det_less_one = strain_functions(real)
    half, one, two = real(0.5), real(1.0), real(2.0)
    third = real(1.0 / 3.0)
    power = real(-2.0 / 3.0)

    @wp.kernel(enable_backward=False, module="unique")
    def recall(
        # In: branch stresses (branch, env, element, point) and gains (env, branch)
        decay: wp.array2d(dtype=real),
        gain: wp.array2d(dtype=real),
        bulk_gain: wp.array2d(dtype=real),
        points: int,
        branch: wp.array4d(dtype=mat33),
        rest: wp.array3d(dtype=mat33),
        bulk_branch: wp.array3d(dtype=real),
        bulk_rest: wp.array2d(dtype=real),
        active: wp.array(dtype=wp.int32),
        # Out:
        history_out: wp.array3d(dtype=mat33),
        bulk_history_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        if active[env] == 0:
            return
        for q in range(points):
            history = mat33()
            for i in range(decay.shape[1]):
                history += branch[i, env, e, q] * decay[env, i] - rest[env, e, q] * gain[env, i]
            history_out[env, e, q] = history
        bulk_history = real(0.0)
        for i in range(decay.shape[1]):
            bulk_history += (
                bulk_branch[i, env, e] * decay[env, i] - bulk_rest[env, e] * bulk_gain[env, i]
            )
        bulk_history_out[env, e] = bulk_history

    @wp.kernel(enable_backward=False, module="unique")
    def keep(
        # Mesh:
        elements: wp.array2d(dtype=wp.int32),
        inverse: wp.array3d(dtype=mat33),
        weight: wp.array3d(dtype=real),
        variant: wp.array(dtype=wp.int32),
        points: int,
        # Material, by environment:
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        decay: wp.array2d(dtype=real),
        gain: wp.array2d(dtype=real),
        bulk_gain: wp.array2d(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # In and out:
        branch_out: wp.array4d(dtype=mat33),
        rest_out: wp.array3d(dtype=mat33),
        bulk_branch_out: wp.array3d(dtype=real),
        bulk_rest_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        last = inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        m = variant[env]
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        volume = real(0.0)
        change = real(0.0)
        for q in range(points):
            h, _sx, _sy, _sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inverse[m, e, wp.min(q, last)])
            less = det_less_one(h)
            volume += weight[m, e, q]
            change += weight[m, e, q] * less
            f = h + wp.identity(n=3, dtype=real)
            c = cofactor(f)
            j = one + less
            square = wp.ddot(f, f)
            g = shear[env] * wp.pow(j, power)
            # S = F^-1 P with F^-1 = cof(F)^T / J
            stress = (
                wp.identity(n=3, dtype=real) - (wp.transpose(c) * c) * (square * third / (j * j))
            ) * g
            for i in range(decay.shape[1]):
                branch_out[i, env, e, q] = (
                    branch_out[i, env, e, q] * decay[env, i]
                    + (stress - rest_out[env, e, q]) * gain[env, i]
                )
            rest_out[env, e, q] = stress
        theta = change / volume
        pressure = half * bulk[env] * theta * (two + theta) / (one + theta)
        for i in range(decay.shape[1]):
            bulk_branch_out[i, env, e] = (
                bulk_branch_out[i, env, e] * decay[env, i]
                + (pressure - bulk_rest_out[env, e]) * bulk_gain[env, i]
            )
        bulk_rest_out[env, e] = pressure

    return recall, keep


class Branches:
    """The Prony branches of every Gauss point of a batch; up to 4 branches."""

    def __init__(self, real, scenes, elements: int, device: str) -> None:
        mat33 = matrix_of(real)
        series = [scene.effects.viscosity for scene in scenes]
        most = max(len(viscosity.ratios) for viscosity in series)
        count = len(scenes)
        self._ratios = np.zeros((count, most))
        self._times = np.ones((count, most))
        self._bulk = np.zeros((count, 1))
        for env, viscosity in enumerate(series):
            self._ratios[env, : len(viscosity.ratios)] = viscosity.ratios
            self._times[env, : len(viscosity.times)] = viscosity.times
            self._bulk[env] = viscosity.relaxes == "all"
        self._real, self._device = real, device
        self._shape = (count, elements)
        points = (count, elements, GAUSS_POINTS)
        self._branch = wp.zeros((most, *points), dtype=mat33, device=device)
        self._rest = wp.zeros(points, dtype=mat33, device=device)
        self._bulk_branch = wp.zeros((most, count, elements), dtype=real, device=device)
        self._bulk_rest = wp.zeros((count, elements), dtype=real, device=device)
        self.history = wp.zeros(points, dtype=mat33, device=device)
        """Stress that does not change within the step (B, E, 8) [E]."""
        self.bulk_history = wp.zeros((count, elements), dtype=real, device=device)
        """The same of the pressure (B, E) [E]."""
        self._decay = self._gain = self._bulk_gain = None

    def begin(self, active, duration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fill `history` of `active` environments for a step of `duration` (B,) [s].

        Returns:
            Factors on stress and pressure (B,), for everyone: whoever is not active must be given
            the duration of the step it is in.
        """
        share = np.maximum(duration, 1e-12)[:, None] / self._times
        gain = self._ratios * -np.expm1(-share) / share
        self._decay, self._gain = self._array(np.exp(-share)), self._array(gain)
        self._bulk_gain = self._array(gain * self._bulk)
        wp.launch(
            _kernels(self._real)[0],
            dim=self._shape,
            inputs=[
                self._decay,
                self._gain,
                self._bulk_gain,
                GAUSS_POINTS,
                self._branch,
                self._rest,
                self._bulk_branch,
                self._bulk_rest,
                active,
            ],
            outputs=[self.history, self.bulk_history],
            device=self._device,
        )
        return 1 + gain.sum(1), 1 + (gain * self._bulk).sum(1)

    def keep(self, mesh, material, active, u) -> None:
        """Take over the state `u` of `active` environments as the end of the step.

        `mesh` is (elements, inverse, weight, variant), `material` (shear, bulk).
        """
        wp.launch(
            _kernels(self._real)[1],
            dim=self._shape,
            inputs=[
                *mesh,
                GAUSS_POINTS,
                *material,
                self._decay,
                self._gain,
                self._bulk_gain,
                active,
                u,
            ],
            outputs=[self._branch, self._rest, self._bulk_branch, self._bulk_rest],
            device=self._device,
        )

    def _array(self, values):
        return wp.array(
            np.ascontiguousarray(values, dtype=numpy_of(self._real)),
            dtype=self._real,
            device=self._device,
        )
