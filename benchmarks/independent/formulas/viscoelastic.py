"""Lee and Radok: indentation of a relaxing body, from its elastic solution.

The modulus is E(t) = E (1 + sum_i ratio_i exp(-t/time_i)), with the equilibrium modulus E;
Poisson's ratio is constant, so the bulk relaxes with the shear. Any elastic force F_el with
modulus E becomes F(t) = int_0^t (E(t - s)/E) dF_el(s), as long as the contact never shrinks: Lee &
Radok, J. Appl. Mech. 27 (1960) 438. Motions are linear between the given times, as in `Motion`;
depth before the first time is 0, so a first depth above 0 is a jump.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import dawsn

from benchmarks.independent.formulas.half_space import reduced_modulus

Array = NDArray[np.float64]


def relaxation_modulus(
    time: ArrayLike, modulus: float, ratios: Sequence[float], times: Sequence[float]
) -> Array:
    """Return E(t) after a step of strain [Pa]; `modulus` is the equilibrium modulus."""
    time = np.asarray(time, float)
    value = np.ones_like(time)
    for ratio, relaxation in zip(ratios, times, strict=True):
        value = value + ratio * np.exp(-time / relaxation)
    return modulus * value


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


def lee_radok_punch(
    time: Sequence[float],
    depth: ArrayLike,
    radius: float,
    modulus: float,
    poisson: float,
    ratios: Sequence[float],
    times: Sequence[float],
    *,
    kappa: float = 1.0,
) -> Array:
    """Return the force of a flat punch [N]: F = 2 a kappa/(1 - nu^2) int E(t - s) d depth(s).

    Valid at `time` (N,) for any history of `depth` (N,) [m], including withdrawal, while the force
    is positive (no adhesion). `kappa` is 1 on the half-space, `hayes_kappa` on a layer.

    Raises:
        ValueError: Times that do not increase, or lengths that differ.
    """
    stiffness = 2 * radius * kappa * reduced_modulus(modulus, poisson)
    return hereditary(time, stiffness * np.asarray(depth, float), ratios, times)


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
