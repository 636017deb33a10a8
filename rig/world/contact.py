"""Closed-form contact of a rigid indenter with a soft layer bonded to a rigid base.

Normal: a flat circular punch by Hayes' table, a sphere by Dimitriadis' series. Tangential: a rigid
disc on a layer over rock. Nothing here has a state or knows time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

_HAYES_RATIO = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0])
_HAYES_POISSON = np.array([0.30, 0.40, 0.45, 0.49, 0.50])
_HAYES = np.array(
    [
        [1.0, 1.0, 1.0, 1.0, 1.0],
        [1.2066, 1.2323, 1.2523, 1.2741, 1.2806],
        [1.4726, 1.5422, 1.5993, 1.6638, 1.6837],
        [1.7848, 1.9178, 2.0328, 2.1694, 2.2129],
        [2.1260, 2.3402, 2.5354, 2.7796, 2.8602],
        [2.4835, 2.7938, 3.0914, 3.4840, 3.6187],
        [3.4090, 4.0100, 4.6576, 5.6322, 6.0030],
        [4.3532, 5.2985, 6.4206, 8.3370, 9.1494],
    ]
)
# Stiffening of a bonded layer under a flat punch, rows a/h, columns Poisson's ratio (Hayes et al.
# 1972, recomputed from the integral equation; a/h = 0 is the half-space).


@dataclass(frozen=True, slots=True)
class Layer:
    """A soft layer, glued to a rigid base.

    Raises:
        ValueError: A value outside the range of the formulas.
    """

    modulus: float = field(metadata={"unit": "kpa"})
    """Young's modulus [Pa]."""
    thickness: float = field(metadata={"unit": "mm"})
    """Thickness [m]."""
    poisson: float = 0.45
    """Poisson's ratio, 0.30 to 0.50."""

    def __post_init__(self) -> None:
        """Refuse what the formulas do not cover."""
        if not self.modulus > 0 or not self.thickness > 0:
            raise ValueError("modulus and thickness: allowed: above 0")
        if not 0.30 <= self.poisson <= 0.50:
            raise ValueError(f"poisson: {self.poisson!r}; allowed: 0.30 to 0.50 (Hayes' table)")

    @property
    def shear_modulus(self) -> float:
        """E / (2 (1 + nu)) [Pa]."""
        return self.modulus / (2 * (1 + self.poisson))

    def disc_shear_stiffness(self, radius: float) -> float:
        """Force per sideways displacement of a disc stuck to the surface [N/m].

        8 G a / (2 - nu) on a half-space (Johnson 1985, 3.7), times 1 + a / (2 h) for a layer over
        rock (Gazetas 1983); good for a / h below about 0.5, a few per cent above.
        """
        return (
            8
            * self.shear_modulus
            * radius
            / (2 - self.poisson)
            * (1 + radius / (2 * self.thickness))
        )


@dataclass(frozen=True, slots=True)
class Punch:
    """A flat-ended circular punch."""

    KIND: ClassVar[str] = "punch"

    radius: float = field(metadata={"unit": "mm"})
    """Radius [m]."""

    def contact_radius(self, layer: Layer, depth: float) -> float:
        """Radius of the contact [m]: that of the punch."""
        return self.radius

    def force(self, layer: Layer, depth: float) -> float:
        """Normal force at `depth` [N]: 2 E a d kappa / (1 - nu^2), kappa from Hayes' table.

        Beyond a/h = 2, where the table ends, kappa is held.
        """
        if depth <= 0:
            return 0.0
        ratio = self.radius / layer.thickness
        by_poisson = [
            float(np.interp(ratio, _HAYES_RATIO, _HAYES[:, k])) for k in range(len(_HAYES_POISSON))
        ]
        kappa = float(np.interp(layer.poisson, _HAYES_POISSON, by_poisson))
        return 2 * layer.modulus * self.radius * depth * kappa / (1 - layer.poisson**2)


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball."""

    KIND: ClassVar[str] = "sphere"

    radius: float = field(metadata={"unit": "mm"})
    """Radius [m]."""

    def contact_radius(self, layer: Layer, depth: float) -> float:
        """Hertz: sqrt(R d) [m]."""
        return math.sqrt(self.radius * max(depth, 0.0))

    def force(self, layer: Layer, depth: float) -> float:
        """Normal force at `depth` [N], Hertz times Dimitriadis' series for a bonded layer.

        Dimitriadis et al. 2002; against the exact solution 3 % low at sqrt(R d) / h = 0.35, 9 % low
        at 0.6.
        """
        if depth <= 0:
            return 0.0
        nu = layer.poisson
        c = math.sqrt(self.radius * depth) / layer.thickness
        a0 = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
        b0 = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
        series = (
            1
            - 2 * a0 / math.pi * c
            + 4 * a0**2 / math.pi**2 * c**2
            - 8 / math.pi**3 * (a0**3 + 4 * math.pi**2 / 15 * b0) * c**3
            + 16 * a0 / math.pi**4 * (a0**3 + 3 * math.pi**2 / 5 * b0) * c**4
        )
        hertz = 4 / 3 * layer.modulus / (1 - nu**2) * math.sqrt(self.radius * depth**3)
        return hertz * series


Indenter = Punch | Sphere
