"""Wide elastic layer bonded to a rigid base, by wave number of the pressure.

Under the pressure p cos(k x) the surface of a layer of thickness h sinks by

    w = 2 (1 - nu^2) / (E k) L(k h) p cos(k x),

where L is 1 on a half-space. Frictionless load, small strain, any Poisson's ratio from 0 to 0.5.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def layer_ratio(alpha: ArrayLike, poisson: float) -> Array:
    """Return L(alpha), alpha = k h >= 0: sinking of the layer over sinking of the half-space.

    With kappa = 3 - 4 nu (the kernel of Hayes et al., J. Biomech. 5 (1972) 541):

        L = (2 kappa sinh 2a - 4 a) / (2 kappa cosh 2a + 1 + kappa^2 + 4 a^2)

    Evaluated with exp(-2a), so nothing overflows, and without the cancellation in the numerator as
    a -> 0 and nu -> 0.5 (L -> 2/3 a^3 there): the relative error is a few 1e-16 for any alpha.
    """
    alpha = np.asarray(alpha, float)
    # This form of kappa - 1 is exact; 2 sinh x - 2 x is separate, as it is small for small x.
    excess = 2 * (1 - 2 * poisson)
    numerator = -excess * np.expm1(-4 * alpha) + _sinh_beyond_linear(2 * alpha)
    ratio: Array = numerator / np.where(alpha > 0, _denominator(alpha, poisson), 1.0)
    return ratio


def layer_deficit(alpha: ArrayLike, poisson: float) -> Array:
    """Return 1 - L(alpha), accurate even where L rounds to 1: it decays as exp(-2 alpha)."""
    alpha = np.asarray(alpha, float)
    once, twice = np.exp(-2 * alpha), np.exp(-4 * alpha)
    kappa = 3 - 4 * poisson
    numerator = 2 * kappa * twice + (1 + kappa**2 + 4 * alpha + 4 * alpha**2) * once
    denominator = _denominator(alpha, poisson)
    deficit: Array = np.divide(numerator, denominator, out=np.ones_like(alpha), where=alpha > 0)
    return deficit


def layer_compliance(
    wave_number: ArrayLike, thickness: float, modulus: float, poisson: float
) -> Array:
    """Return the sinking of the surface over pressure, w / p at wave number k [m/Pa].

    2 (1 - nu^2) / (E k) L(k h). The limit at k = 0 is h / M with the oedometric modulus M.
    """
    alpha = np.asarray(wave_number, float) * thickness
    slope = (1 - 2 * poisson) / (2 * (1 - poisson) ** 2)
    ratio = layer_ratio(alpha, poisson)
    per_alpha = np.divide(ratio, alpha, out=np.full_like(alpha, slope), where=alpha > 0)
    compliance: Array = 2 * (1 - poisson**2) * thickness / modulus * per_alpha
    return compliance


def _denominator(alpha: Array, poisson: float) -> Array:
    """Return the denominator of L as written in `layer_ratio`, times exp(-2 alpha)."""
    once, kappa = np.exp(-2 * alpha), 3 - 4 * poisson
    value: Array = kappa * (1 + once**2) + (1 + kappa**2 + 4 * alpha**2) * once
    return value


def _sinh_beyond_linear(x: Array) -> Array:
    """Return 2 exp(-x) (sinh x - x) for x >= 0, to full relative precision."""
    square = np.minimum(x, 1.0) ** 2
    series = np.ones_like(x)
    # sinh x - x = x^3/6 (1 + x^2/(4 5) (1 + x^2/(6 7) (1 + ...))); the first neglected term is
    # below 1e-16 of the first for x <= 1.
    for even in (18, 16, 14, 12, 10, 8, 6, 4):
        series = 1 + square / (even * (even + 1)) * series
    small = np.exp(-x) * np.minimum(x, 1.0) ** 3 / 3 * series
    return np.where(x < 1.0, small, -np.expm1(-2 * x) - 2 * x * np.exp(-x))
