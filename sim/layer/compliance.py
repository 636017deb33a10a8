"""The compliance of a bonded elastic layer, wave by wave: what its top does under a traction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Compliance:
    """Displacement over traction of the top, for waves of wave number k [m/Pa]; shaped as k.

    A traction (along, across, normal) exp(i k x) with x along the wave gives the displacement

        along  = from_along * along + i coupling * normal
        across = from_across * across
        normal = from_normal * normal - i coupling * along
    """

    from_along: Array
    from_across: Array
    from_normal: Array
    coupling: Array


def compliance(
    wave_number: Array, *, thickness: float, shear_modulus: float, poisson: float
) -> Compliance:
    """The compliance at each wave number k >= 0 [rad/m] of a layer [m, Pa] bonded to a rigid base.

    The plane-strain field of a wave is (a + b z) exp(k z) + (c + d z) exp(-k z); clamped below and
    loaded on top it solves to the closed forms here, with q = k h, kappa = 3 - 4 nu and everything
    divided by exp(2 q), so that no wave number overflows. `from_normal` is the textbook form
    (2 kappa sinh 2q - 4q) / (2 kappa cosh 2q + 1 + kappa^2 + 4 q^2) * (1 - nu) / (G k). At k = 0:
    simple shear h / G, confined compression h / (K + 4 G / 3).
    """
    uniform = wave_number == 0
    k = np.where(uniform, 1.0, wave_number)
    kappa = 3 - 4 * poisson
    q = k * thickness
    decay = np.exp(-2 * q)
    below = kappa * (1 + decay**2) + (1 + kappa**2 + 4 * q**2) * decay
    sinh = kappa * (1 - decay**2)
    bend = (1 - poisson) / (shear_modulus * k * below)
    confined = 2 * shear_modulus * (1 - poisson) / (1 - 2 * poisson)
    couple = 4 * q**2 * decay - (1 - 2 * poisson) * kappa * (1 - decay) ** 2
    return Compliance(
        from_along=np.where(uniform, thickness / shear_modulus, bend * (sinh + 4 * q * decay)),
        from_across=np.where(uniform, thickness / shear_modulus, np.tanh(q) / (shear_modulus * k)),
        from_normal=np.where(uniform, thickness / confined, bend * (sinh - 4 * q * decay)),
        coupling=np.where(uniform, 0.0, couple / (2 * shear_modulus * k * below)),
    )
