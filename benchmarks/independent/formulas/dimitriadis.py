"""Dimitriadis' formula for a sphere on a bonded layer, valid for shallow presses only."""

from __future__ import annotations

import math

from benchmarks.independent.formulas.half_space import hertz, hertz_contact_radius


def dimitriadis(
    depth: float, radius: float, thickness: float, modulus: float, poisson: float
) -> float:
    """Return the force of a paraboloid on a bonded layer [N], as a series in c = sqrt(R d) / h.

    F = F_Hertz (1 - 2 A/pi c + 4 A^2/pi^2 c^2 - 8/pi^3 (A^3 + 4 pi^2/15 B) c^3
        + 16 A/pi^4 (A^3 + 3 pi^2/5 B) c^4),
    A = -(1.2876 - 1.4678 nu + 1.3442 nu^2)/(1 - nu),
    B = (0.6387 - 1.0277 nu + 1.5164 nu^2)/(1 - nu):
    Dimitriadis et al., Biophys. J. 82 (2002) 2798, with their coefficients of a bonded layer.

    Usable as a reference only below c = 0.25 and for nu of 0.3 or more: its error relative to
    `layer_paraboloid` is -0.2, -1.4, -3.1, -6.3, -14 % at c = 0.1, 0.25, 0.35, 0.5, 1 (nu = 0.45),
    and at nu = 0.5 -0.2, -1.8, -4.0, -8.3, -20 %. Most of it is due to the term in c^2, for which
    the exact equation gives 7/6 of this one. For nu = 0.5 the paper prints +0.0975 c^4, this form
    gives -0.0973.
    """
    pi = math.pi
    first = -(1.2876 - 1.4678 * poisson + 1.3442 * poisson**2) / (1 - poisson)
    second = (0.6387 - 1.0277 * poisson + 1.5164 * poisson**2) / (1 - poisson)
    ratio = hertz_contact_radius(depth, radius) / thickness
    series = (
        1
        - 2 * first / pi * ratio
        + 4 * first**2 / pi**2 * ratio**2
        - 8 / pi**3 * (first**3 + 4 * pi**2 / 15 * second) * ratio**3
        + 16 * first / pi**4 * (first**3 + 3 * pi**2 / 5 * second) * ratio**4
    )
    return hertz(depth, radius, modulus, poisson) * series
