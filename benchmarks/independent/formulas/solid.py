"""Neo-Hookean material of `Body` under homogeneous deformation, with closed-form stress.

W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((J^2 - 1)/2 - ln J), G = E/(2 (1 + nu)),
K = E/(3 (1 - 2 nu)). Stresses are nominal: force over undeformed area, first Piola-Kirchhoff
P = dW/dF, positive in tension. Valid for any stretch above 0 and Poisson's ratio below 0.5.
"""

from __future__ import annotations

import math

from scipy.optimize import brentq


def confined_stress(stretch: float, modulus: float, poisson: float) -> float:
    """Return the axial stress of a body that cannot widen, F = diag(1, 1, s) [Pa].

    P = 2 G/3 (s^(1/3) - s^(-5/3)) + K/2 (s - 1/s), from W with J = s and tr(F^T F) = 2 + s^2; its
    slope at s = 1 is the oedometric modulus K + 4 G/3. This is a wide layer under a wide plate.
    """
    shear, bulk = _moduli(modulus, poisson)
    isochoric = 2 * shear / 3 * (math.pow(stretch, 1 / 3) - math.pow(stretch, -5 / 3))
    return isochoric + bulk / 2 * (stretch - 1 / stretch)


def uniaxial_stress(stretch: float, modulus: float, poisson: float) -> float:
    """Return the axial stress of a bar with free sides, F = diag(q, q, s) [Pa].

    q^2 = J/s, with J from the condition of stress-free sides:
    K/2 (J - 1/J) = G/3 J^(-5/3) (s^2 - J/s). Then P = G J^(-5/3) (s^2 - q^2) q^2; its slope at
    s = 1 is E.
    """
    shear, bulk = _moduli(modulus, poisson)

    def side_stress(volume: float) -> float:
        deviator = shear / 3 * math.pow(volume, -5 / 3) * (stretch**2 - volume / stretch)
        return bulk / 2 * (volume - 1 / volume) - deviator

    # The root lies between constant volume and constant proportions (J = s^3).
    low, high = sorted((1.0, stretch**3))
    volume = 1.0 if low == high else float(brentq(side_stress, low, high, xtol=1e-15, rtol=1e-15))
    side = volume / stretch
    return shear * math.pow(volume, -5 / 3) * (stretch**2 - side) * side


def simple_shear_stress(amount: float, modulus: float, poisson: float) -> tuple[float, float]:
    """Return shear and normal stress on a face that moves by u_x = amount z [Pa].

    (G g, -G g^2/3): J = 1, so P = G (F - tr(F^T F)/3 F^-T). The face pushes outwards (negative
    normal stress) unless it is free to lift.
    """
    shear, _ = _moduli(modulus, poisson)
    return shear * amount, -shear * amount**2 / 3


def _moduli(modulus: float, poisson: float) -> tuple[float, float]:
    return modulus / (2 * (1 + poisson)), modulus / (3 * (1 - 2 * poisson))
