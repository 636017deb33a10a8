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
Comput. Methods Appl. Mech. Eng. 85, 1991). The solution is that of the whole stiffness. Pressures
that alternate from element to element hardly move anything and settle slowly; so the fraction that
follows grows after every few settlings, up to the whole.

An element's pressure depends on its volume through the material's law p(theta), and with viscosity
on its history: law = growth p(theta) + history. The kernels compute factor law + rest; with
rest = (1 - factor) pressure the fixed point is the law.
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
# Settlings of one solve after which the fraction that follows the volume grows by the second.
SETTLINGS, STIFFER = 6, 4.0


def split_factor(poisson: float) -> float:
    """Return the fraction of the pressure that follows the volume within a solve; 1: all of it."""
    if poisson <= SPLIT_ABOVE:
        return 1.0
    return (1 - 2 * poisson) / (1 - 2 * SPLIT_LIKE)


@functools.cache
def _kernels(real):
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
        bulk_factor: wp.array(dtype=real),
        factor: wp.array(dtype=real),
        history: wp.array2d(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # Out:
        pressure_out: wp.array2d(dtype=real),
        # In and out:
        kept_out: wp.array2d(dtype=real),
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
        pressure = bulk_factor[env] * pressure_of(bulk[env], theta) + kept_out[env, e]
        pressure_out[env, e] = pressure
        kept_out[env, e] = factor[env] * history[env, e] + (one - factor[env]) * pressure

    @wp.kernel(enable_backward=False, module="unique")
    def compose(
        # In:
        factor: wp.array(dtype=real),
        history: wp.array2d(dtype=real),
        pressure: wp.array2d(dtype=real),
        active: wp.array(dtype=wp.int32),
        # Out:
        kept_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        if active[env] == 1:
            rest = (one - factor[env]) * pressure[env, e]
            kept_out[env, e] = factor[env] * history[env, e] + rest

    return settle, compose


class VolumePressure:
    """Pressure of the elements of B environments at the last settled state, and its fraction kept.

    Args:
        real: Warp's scalar type.
        poisson: Poisson's ratios (B,).
        elements: Number of elements, E.
        device: Device of the arrays.
        history: Pressure by viscosity that does not change within a step (B, E) [E]; None: none.
    """

    def __init__(
        self, real, poisson: NDArray[np.float64], elements: int, device: str, history=None
    ) -> None:
        self._least = np.array([split_factor(one) for one in poisson])
        self.fraction = self._least.copy()
        """Fraction of the pressure that follows the volume (B,)."""
        self._factor = wp.array(self.fraction.astype(numpy_of(real)), dtype=real, device=device)
        self.pressure = wp.zeros((len(poisson), elements), dtype=real, device=device)
        """Pressure at the last settled state (B, E) [E]."""
        self.kept = wp.zeros_like(self.pressure)
        """Part of the pressure that does not follow the volume: an input of element kernels."""
        self._history = wp.zeros_like(self.pressure) if history is None else history
        self.pressure_old = wp.zeros_like(self.pressure)
        """The same at the last accepted step."""
        self._whole = wp.zeros_like(self.pressure)
        self._real, self._device = real, device

    def stiffen(self, chosen: NDArray[np.bool_], factor: float) -> None:
        """Multiply the fraction that follows by `factor`, up to 1; with 0 return to the least."""
        self.fraction[chosen] = np.clip(factor * self.fraction, self._least, 1.0)[chosen]
        self._factor.assign(self.fraction.astype(numpy_of(self._real)))

    def compose(self, active) -> None:
        """Update `kept` where the pressure, the fraction or the history has changed."""
        wp.launch(
            _kernels(self._real)[1],
            dim=self.kept.shape,
            inputs=[self._factor, self._history, self.pressure, active],
            outputs=[self.kept],
            device=self._device,
        )

    def settle(self, mesh, bulk, bulk_factor, active, u) -> None:
        """Set the pressure to that at `u`.

        `mesh` is (elements, inverse, weight, variant), `bulk` (B,) the modulus, `bulk_factor` (B,)
        the factor on its pressure.
        """
        wp.launch(
            _kernels(self._real)[0],
            dim=self.kept.shape,
            inputs=[
                *mesh,
                GAUSS_POINTS,
                bulk,
                bulk_factor,
                self._factor,
                self._history,
                active,
                u,
            ],
            outputs=[self.pressure, self.kept],
            device=self._device,
        )

    def accept(self, active) -> None:
        """Make the current pressure that of the last accepted step."""
        copy_active(active, self.pressure, self.pressure_old)

    def roll_back(self, active) -> None:
        """Return to the pressure of the last accepted step."""
        copy_active(active, self.pressure_old, self.pressure)

    def put_within(self, active, fraction: float) -> None:
        """Set the pressure a fraction of the way through the step: one half, then the whole."""
        if fraction < 1.0:
            copy_active(active, self.pressure, self._whole)
            mean = fraction * self.pressure.numpy() + (1 - fraction) * self.pressure_old.numpy()
            within = wp.array(mean.astype(numpy_of(self._real)), device=self._device)
            copy_active(active, within, self.pressure)
        else:
            copy_active(active, self._whole, self.pressure)
