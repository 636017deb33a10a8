# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Nearly incompressible bodies: the pressure of each element follows its volume step by step.

Close to a Poisson's ratio of 0.5 a body resists changes of volume hundreds of times as much as
shear. Its tangent is then so hard to solve that each of Newton's iterations takes 60 to 140 cycles
of the preconditioner, where 10 to 20 are enough at 0.49.

So the pressure is split, as that of contact is (`sim.fem.contact`): a fraction follows the volume
within a solve, with the stiffness of a Poisson's ratio of 0.47, and the rest is what the whole was
before. Once a state is balanced, the rest is set to its fraction of the new pressure, and the state
solved again, until that no longer disturbs the balance (augmented Lagrangian method; Simo & Taylor,
Comput. Methods Appl. Mech. Eng. 85, 1991). The solution is that of the whole stiffness.

An element's pressure depends on its volume through the material's law p(theta). The kernels compute
`factor` p(theta) + `rest`; with rest = (1 - factor) pressure its fixed point is p(theta).
"""

import functools

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.fem.element import GAUSS_POINTS, kinematics, mode_functions
from sim.fem.vectors import copy_active
from sim.scalars import matrix_of, numpy_of, vector_of

# Poisson's ratio above which the pressure is split, and that of the stiffness within a solve.
SPLIT_ABOVE, SPLIT_LIKE = 0.495, 0.47


def split_factor(poisson: float) -> float:
    """Return the fraction of the pressure that follows the volume within a solve; 1: all of it."""
    if poisson <= SPLIT_ABOVE:
        return 1.0
    return (1 - 2 * poisson) / (1 - 2 * SPLIT_LIKE)


@functools.cache
def _settle_kernel(real):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, _scatter = mode_functions(real)
    _strain, _cofactor, _deformed, mean_change, pressure_of = kinematics(real)
    one = real(1.0)

    @wp.kernel(enable_backward=False, module="unique")
    def settle(
        # Mesh:
        elements: wp.array2d(dtype=wp.int32),
        inverse: wp.array3d(dtype=mat33),
        weight: wp.array3d(dtype=real),
        variant: wp.array(dtype=wp.int32),
        points: int,
        # Material, by environment:
        bulk: wp.array(dtype=real),
        factor: wp.array(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # In and out:
        rest_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        if active[env] == 0:
            return
        m = variant[env]
        if weight[m, e, 0] == real(0.0):  # outside a round body
            return
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        _volume, theta, _lowest = mean_change(
            inverse, weight, m, e, points, u1, u2, u3, u4, u5, u6, u7
        )
        pressure = factor[env] * pressure_of(bulk[env], theta) + rest_out[env, e]
        rest_out[env, e] = (one - factor[env]) * pressure

    return settle


class VolumePressure:
    """Pressure of the elements of B environments that does not follow the volume in a solve."""

    def __init__(self, real, poisson: NDArray[np.float64], elements: int, device: str) -> None:
        factor = np.array([split_factor(one) for one in poisson], numpy_of(real))
        self.factor = wp.array(factor, dtype=real, device=device)
        """Fraction of the pressure that follows the volume (B,)."""
        self.rest = wp.zeros((len(factor), elements), dtype=real, device=device)
        """Pressure that does not (B, E) [E]."""
        self.rest_old = wp.zeros_like(self.rest)
        """The same at the last accepted step."""
        self._whole = wp.zeros_like(self.rest)
        self._real, self._device = real, device

    def settle(self, mesh, bulk, active, u) -> None:
        """Set the rest to its fraction of the pressure at `u`.

        `mesh` is (elements, inverse, weight, variant), `bulk` (B,).
        """
        wp.launch(
            _settle_kernel(self._real),
            dim=self.rest.shape,
            inputs=[*mesh, GAUSS_POINTS, bulk, self.factor, active, u],
            outputs=[self.rest],
            device=self._device,
        )

    def accept(self, active) -> None:
        """Make the current pressure that of the last accepted step."""
        copy_active(active, self.rest, self.rest_old)

    def roll_back(self, active) -> None:
        """Return to the pressure of the last accepted step."""
        copy_active(active, self.rest_old, self.rest)

    def put_within(self, active, fraction: float) -> None:
        """Set the pressure a fraction of the way through the step: one half, then the whole."""
        if fraction < 1.0:
            copy_active(active, self.rest, self._whole)
            mean = (self.rest.numpy() * fraction) + (1 - fraction) * self.rest_old.numpy()
            half = wp.array(mean, dtype=self._real, device=self._device)
            copy_active(active, half, self.rest)
        else:
            copy_active(active, self._whole, self.rest)
