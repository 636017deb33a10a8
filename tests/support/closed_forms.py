"""Closed forms of half-spaces, rubbing spheres, rubber and memory, as oracles of the simulator.

SI units; a force that presses and a depth are positive. Displacements are in the contact frame: z
points out of the material. E is Young's modulus, nu Poisson's ratio, G and K are shear and bulk
modulus. `benchmarks.independent.formulas` has those that benchmarks use.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from benchmarks.independent.formulas import reduced_modulus, shear_and_bulk

Array = NDArray[np.float64]

# Elastic half-space. Strain must be small: the contact radius small compared with the indenter's
# radius, and (for a layer) with the thickness.


def hertz(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Return the force of a sphere, as a paraboloid [N]: F = 4/3 E* sqrt(R) d^1.5, or 0.

    Johnson, Contact Mechanics (1985), eqs. 4.22 to 4.24; 0 without contact. Valid for contact
    radius << R; the force of a true sphere differs by 1 % at d = 0.1 R.
    """
    stiffness = 4 / 3 * reduced_modulus(modulus, poisson) * math.sqrt(radius)
    return stiffness * math.pow(max(depth, 0.0), 1.5)


def flat_punch(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Return the force of a flat circular punch [N]: F = 2 a E* d; 0 without contact.

    Sneddon (1965); Johnson (1985), section 3.4.
    """
    return 2 * radius * reduced_modulus(modulus, poisson) * max(depth, 0.0)


def cone(depth: float, half_angle: float, modulus: float, poisson: float) -> float:
    """Return the force of a cone, `half_angle` [rad] from axis to side: F = 2/pi E* tan(angle) d^2.

    Sneddon (1965), in [N]. Linear theory, for blunt cones near pi/2; 0 without contact.
    """
    factor = 2 / math.pi * reduced_modulus(modulus, poisson)
    return factor * math.tan(half_angle) * max(depth, 0.0) ** 2


# A point force acts at the origin of a half-space's surface, where the solution is singular.


def boussinesq(x: ArrayLike, y: ArrayLike, force: float, modulus: float, poisson: float) -> Array:
    """Return the displacement (..., 3) at (x, y) [m] under `force` along +z (pulling) [N].

    u_z = (1 - nu^2) F / (pi E r), u_r = (1 + nu)(1 - 2 nu) F / (2 pi E r): Johnson, Contact
    Mechanics (1985), eqs. 3.22, with both axes reversed to point out of the material.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    r = np.hypot(x, y)
    radial = (1 + poisson) * (1 - 2 * poisson) * force / (2 * math.pi * modulus * r)
    upward = (1 - poisson**2) * force / (math.pi * modulus * r)
    return np.stack(np.broadcast_arrays(radial * x / r, radial * y / r, upward), axis=-1)


def cerruti(x: ArrayLike, y: ArrayLike, force: float, modulus: float, poisson: float) -> Array:
    """Return the displacement (..., 3) at (x, y) [m] under `force` along +x [N].

    With G = E / (2 (1 + nu)): u_x = F/(2 pi G) ((1 - nu)/r + nu x^2/r^3),
    u_y = F/(2 pi G) nu x y/r^3, u_z = -F/(4 pi G) (1 - 2 nu) x/r^2: Johnson (1985), eqs. 3.75,
    with the z axis reversed to point out of the material.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    r = np.hypot(x, y)
    scale = force * (1 + poisson) / (math.pi * modulus)
    along = scale * ((1 - poisson) / r + poisson * x**2 / r**3)
    across = scale * poisson * x * y / r**3
    upward = -scale / 2 * (1 - 2 * poisson) * x / r**2
    return np.stack(np.broadcast_arrays(along, across, upward), axis=-1)


# Cattaneo (1938), Mindlin (1949); Johnson (1985), section 7.2: a rigid sphere on a half-space,
# pressed by N, then pushed sideways by T <= mu N. The contact (Hertz radius a) sticks within r < c.
# Neglected: N drags the surface inwards (except at nu = 0.5), and points slip a little across T
# (except at nu = 0).


def mindlin_stick_radius(
    tangential: float, normal: float, coefficient: float, contact_radius: float
) -> float:
    """Return the radius of the sticking core [m]: c = a (1 - T/(mu N))^(1/3).

    Raises:
        ValueError: |T| above mu N.
    """
    most = coefficient * normal
    if not abs(tangential) <= most:
        raise ValueError(f"tangential: {tangential!r} N; allowed: -{most:g} to {most:g} N (mu N)")
    return contact_radius * float(np.cbrt(1 - abs(tangential) / most))


def mindlin_displacement(
    tangential: float,
    normal: float,
    coefficient: float,
    contact_radius: float,
    modulus: float,
    poisson: float,
) -> float:
    """Return the sideways shift of the sphere relative to the far body, on first loading [m].

    D = 3 mu N (2 - nu) / (16 a G) (1 - (1 - T/(mu N))^(2/3)), the last power being (c/a)^2.

    Raises:
        ValueError: |T| above mu N.
    """
    core = mindlin_stick_radius(tangential, normal, coefficient, contact_radius) / contact_radius
    shear, _ = shear_and_bulk(modulus, poisson)
    shift = 3 * coefficient * normal * (2 - poisson) / (16 * contact_radius * shear)
    return math.copysign(shift * (1 - core**2), tangential)


# Neo-Hookean material of `Body` under homogeneous deformation:
#     W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((J^2 - 1)/2 - ln J).
# Stresses are nominal (force over undeformed area, P = dW/dF), positive in tension. Valid for any
# stretch above 0 and Poisson's ratio below 0.5.


def confined_stress(stretch: float, modulus: float, poisson: float) -> float:
    """Return the axial stress of a body that cannot widen, F = diag(1, 1, s) [Pa].

    P = 2 G/3 (s^(1/3) - s^(-5/3)) + K/2 (s - 1/s), from W with J = s and tr(F^T F) = 2 + s^2; its
    slope at s = 1 is the oedometric modulus K + 4 G/3. This is a wide layer under a wide plate.
    """
    shear, bulk = shear_and_bulk(modulus, poisson)
    isochoric = 2 * shear / 3 * (math.pow(stretch, 1 / 3) - math.pow(stretch, -5 / 3))
    return isochoric + bulk / 2 * (stretch - 1 / stretch)


def uniaxial_stress(stretch: float, modulus: float, poisson: float) -> float:
    """Return the axial stress of a bar with free sides, F = diag(q, q, s) [Pa].

    q^2 = J/s, with J from the condition of stress-free sides:
    K/2 (J - 1/J) = G/3 J^(-5/3) (s^2 - J/s). Then P = G J^(-5/3) (s^2 - q^2) q^2; its slope at
    s = 1 is E.
    """
    shear, bulk = shear_and_bulk(modulus, poisson)

    def side_stress(volume: float) -> float:
        deviator = shear / 3 * math.pow(volume, -5 / 3) * (stretch**2 - volume / stretch)
        return bulk / 2 * (volume - 1 / volume) - deviator

    # The root lies between constant volume and constant proportions (J = s^3).
    low, high = sorted((1.0, stretch**3))
    volume = 1.0 if low == high else float(brentq(side_stress, low, high, xtol=1e-15, rtol=1e-15))
    side = volume / stretch
    return shear * math.pow(volume, -5 / 3) * (stretch**2 - side) * side


# Viscosity of a linear body: E(t) = E (1 + sum_i ratio_i exp(-t/time_i)) with the equilibrium
# modulus E; nu is constant.


def hereditary(
    time: Sequence[float], force: ArrayLike, ratios: Sequence[float], times: Sequence[float]
) -> Array:
    """Return the force at `time` (N,) [N] of a body whose equilibrium elastic force is `force`.

    int_0^t (E(t - s)/E) dF_el(s), exact if the elastic force is linear between the times (a punch
    with linear motion); otherwise use many times. The contact must not shrink: Lee & Radok,
    J. Appl. Mech. 27 (1960) 438.

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
