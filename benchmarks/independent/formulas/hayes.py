"""Flat punch on a bonded layer: Hayes' factor kappa, as tables and computed."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from benchmarks.independent.formulas.axisymmetric import layer_punch

# Poisson's ratios of the columns of `HAYES_KAPPA`.
HAYES_POISSON = (0.30, 0.40, 0.45, 0.49, 0.50)

# kappa at punch radius over thickness a/h (keys) and `HAYES_POISSON` (columns), from Hayes'
# integral equation solved to convergence; all digits are significant.
HAYES_KAPPA: Mapping[float, tuple[float, ...]] = MappingProxyType(
    {
        0.2: (1.2066, 1.2323, 1.2523, 1.2741, 1.2806),
        0.4: (1.4726, 1.5422, 1.5993, 1.6638, 1.6837),
        0.6: (1.7848, 1.9178, 2.0328, 2.1694, 2.2129),
        0.8: (2.1260, 2.3402, 2.5354, 2.7796, 2.8602),
        1.0: (2.4835, 2.7938, 3.0914, 3.4840, 3.6187),
        1.5: (3.4090, 4.0100, 4.6576, 5.6322, 6.0030),
        2.0: (4.3532, 5.2985, 6.4206, 8.3370, 9.1494),
    }
)

# kappa at a/h for nu = 0.5 as printed in the paper (Hayes, Keer, Herrmann & Mockros, J. Biomech.
# 5 (1972) 541) and used in cartilage studies; up to 0.9 % below the converged values.
HAYES_PRINTED: Mapping[float, float] = MappingProxyType(
    {
        0.2: 1.281,
        0.4: 1.683,
        0.6: 2.211,
        0.8: 2.855,
        1.0: 3.609,
        1.5: 5.970,
        2.0: 9.069,
    }
)


def hayes_kappa(ratio: float, poisson: float) -> float:
    """Return the factor kappa of F = 2 a E d kappa / (1 - nu^2) at a/h = `ratio`, nu up to 0.5.

    It is 1 on the half-space; solved here to 1e-10 up to a/h = 80.
    """
    force = layer_punch(1.0, ratio, 1.0, 1.0, poisson).force
    return force * (1 - poisson**2) / (2 * ratio)
