"""Viscosity, weight and inertia of a linear body.

The modulus is E(t) = E (1 + sum_i ratio_i exp(-t/time_i)) with the equilibrium modulus E; Poisson's
ratio is constant. An elastic force F_el with modulus E becomes F(t) = int_0^t (E(t - s)/E) dF_el(s)
as long as the contact never shrinks: Lee & Radok, J. Appl. Mech. 27 (1960) 438. Motions are linear
between the given times, as in `Motion`; a first depth above 0 is a jump. A wide bonded layer, from
z = -h to 0, is a function of height at several heights from its sides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import dawsn

from benchmarks.independent.formulas.half_space import reduced_modulus

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
    at, force = _checked(time, force, "force")
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


def lee_radok_sphere(
    time: Sequence[float],
    depth: ArrayLike,
    radius: float,
    modulus: float,
    poisson: float,
    ratios: Sequence[float],
    times: Sequence[float],
) -> Array:
    """Return the force of a sphere on a half-space at `time` (N,) [N].

    F = 4 sqrt(R) / (3 (1 - nu^2)) int_0^t E(t - s) d(depth^1.5)(s), for a `depth` (N,) [m] that
    never decreases, within the limits of Hertz. Exact: on a linear piece the integral is a Dawson
    function.

    Raises:
        ValueError: A depth that decreases or starts below 0, times that do not increase, or lengths
            that differ.
    """
    at, depth = _checked(time, depth, "depth")
    if depth[0] < 0 or np.any(np.diff(depth) < 0):
        raise ValueError("depth: decreases, or starts below 0; allowed: 0 or above, nondecreasing")
    total = depth**1.5
    for ratio, relaxation in zip(ratios, times, strict=True):
        memory = np.empty_like(depth)
        memory[0] = depth[0] ** 1.5
        for index, span in enumerate(np.diff(at), start=1):
            fresh = _relaxed_rise(depth[index - 1], depth[index], span, relaxation)
            memory[index] = memory[index - 1] * math.exp(-span / relaxation) + fresh
        total = total + ratio * memory
    return 4 / 3 * math.sqrt(radius) * reduced_modulus(modulus, poisson) * total


def _relaxed_rise(start: float, end: float, span: float, relaxation: float) -> float:
    """Return int exp(-(t - s)/relaxation) d(depth^1.5)(s) over one piece that ends at t [m^1.5].

    With y = depth / (speed relaxation), d(depth^1.5) is 3/2 (speed relaxation)^1.5 sqrt(y) dy, and
    int_0^Y exp(y - Y) sqrt(y) dy = sqrt(Y) - D(sqrt Y), D being Dawson's function.
    """
    if end <= start:
        return 0.0
    scale = (end - start) / span * relaxation
    roots = math.sqrt(start / scale), math.sqrt(end / scale)
    before, after = (root - float(dawsn(root)) for root in roots)
    return 1.5 * math.pow(scale, 1.5) * (after - math.exp(-span / relaxation) * before)


def _checked(time: Sequence[float], values: ArrayLike, name: str) -> tuple[Array, Array]:
    at, values = np.asarray(time, float), np.asarray(values, float)
    if at.ndim != 1 or at.shape != values.shape:
        raise ValueError(f"{name}: shape {values.shape}; allowed: that of time, {at.shape}, 1-D")
    if np.any(np.diff(at) <= 0):
        raise ValueError("time: not increasing; allowed: increasing [s]")
    return at, values


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
