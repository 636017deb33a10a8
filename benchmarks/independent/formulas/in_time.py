"""Viscosity, weight and inertia of a linear body.

The modulus is E(t) = E (1 + sum_i ratio_i exp(-t/time_i)) with the equilibrium modulus E; Poisson's
ratio is constant. An elastic force F_el with modulus E becomes F(t) = int_0^t (E(t - s)/E) dF_el(s)
as long as the contact never shrinks: Lee & Radok, J. Appl. Mech. 27 (1960) 438. A wide bonded
layer, from z = -h to 0, is a function of height at several heights from its sides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def hereditary(
    time: Sequence[float], force: ArrayLike, ratios: Sequence[float], times: Sequence[float]
) -> Array:
    """Return the force at `time` (N,) [N] of a body whose equilibrium elastic force is `force`.

    int_0^t (E(t - s)/E) dF_el(s), exact if the elastic force is linear between the times (a punch
    with linear motion); otherwise use many times. The contact must not shrink.

    Raises:
        ValueError: Times that do not increase, or lengths that differ.
    """
    at, force = np.asarray(time, float), np.asarray(force, float)
    if at.ndim != 1 or at.shape != force.shape:
        raise ValueError(f"force: shape {force.shape}; allowed: that of time, {at.shape}, 1-D")
    if np.any(np.diff(at) <= 0):
        raise ValueError("time: not increasing; allowed: increasing [s]")
    total = force.copy()
    for ratio, relaxation in zip(ratios, times, strict=True):
        memory = np.empty_like(force)
        memory[0] = force[0]
        for index, span in enumerate(np.diff(at), start=1):
            slope = (force[index] - force[index - 1]) / span
            fresh = -slope * relaxation * math.expm1(-span / relaxation)
            memory[index] = memory[index - 1] * math.exp(-span / relaxation) + fresh
        total += ratio * memory
    return total


def oedometric_modulus(modulus: float, poisson: float) -> float:
    """Return M = E (1 - nu) / ((1 + nu)(1 - 2 nu)) [Pa]: confined stress over strain."""
    return modulus * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))


def layer_sag(
    z: ArrayLike,
    acceleration: Sequence[float],
    thickness: float,
    density: float,
    modulus: float,
    poisson: float,
) -> Array:
    """Return the displacement (..., 3) at height `z` under a uniform acceleration (x, y, z) [m].

    u_i = density a_i (h^2 - z^2) / (2 C_i), C = (G, G, M): the solution of C u'' + density a = 0,
    u(-h) = 0, u'(0) = 0. The top sinks by density g h^2 / (2 M).
    """
    shear = modulus / (2 * (1 + poisson))
    stiffness = np.array([shear, shear, oedometric_modulus(modulus, poisson)])
    profile = (thickness**2 - np.square(np.asarray(z, float))) / 2
    sag: Array = profile[..., None] * density * np.asarray(acceleration, float) / stiffness
    return sag


def compression_frequency(
    thickness: float, density: float, modulus: float, poisson: float, *, overtone: int = 0
) -> float:
    """Return the vertical frequency [Hz]: (2 n + 1) c_p / (4 h), c_p = sqrt(M / density)."""
    speed = math.sqrt(oedometric_modulus(modulus, poisson) / density)
    return (2 * overtone + 1) * speed / (4 * thickness)
