"""Profiles of round indenters: signed distance in the half-plane (r, z), tip at z = 0.

Every profile is a core that is grown by `rounding` on all sides: a point (sphere, ring), an upright
strip (punch, flat tube) or an upright cone (cone with a round or flat tip). Distance, normal and
curvature of such a body are exact up to a penetration of `rounding`.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["sphere", "torus", "punch", "tube", "cone"]


@dataclass(frozen=True)
class Profile:
    """One profile, built by the functions below."""

    kind: Kind
    inner: float
    """Smallest r of the core [m]."""
    outer: float
    """Largest r of the core [m]; of a cone, that of its flat end."""
    rounding: float
    """Distance by which the body extends beyond the core [m]."""
    half_angle: float = 0.0
    """Angle from the axis to the side of a cone [rad]."""

    def distance(self, r: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Return the signed distance [m], its gradient in r and in z, and its curvature [1/m]."""
        if self.kind == "cone":
            return self._from_cone(r, z)
        round_section = self.kind in ("sphere", "torus")
        near_r = np.clip(r, self.inner, self.outer)
        near_z = np.clip(z, self.rounding, self.rounding if round_section else np.inf)
        length = np.maximum(np.hypot(r - near_r, z - near_z), 1e-300)
        bend = np.where(round_section | (near_r != r) & (near_z != z), 1 / length, 0.0)
        return length - self.rounding, (r - near_r) / length, (z - near_z) / length, bend

    def _from_cone(self, r: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        cosine, sine = math.cos(self.half_angle), math.sin(self.half_angle)
        up, beside = z - self.rounding, np.maximum(r - self.outer, 0.0)
        tip = beside * sine + up * cosine <= 0
        length = np.maximum(np.hypot(beside, up), 1e-300)
        gap = np.where(tip, length, (r - self.outer) * cosine - up * sine) - self.rounding
        normal_r = np.where(tip, beside / length, cosine)
        normal_z = np.where(tip, up / length, -sine)
        bends = tip & ((beside > 0) | (self.outer == 0))
        return gap, normal_r, normal_z, np.where(bends, 1 / length, 0.0)


def sphere(radius: float) -> Profile:
    """Return a sphere [m]."""
    return Profile("sphere", 0.0, 0.0, radius)


def torus(ring_radius: float, tube_radius: float) -> Profile:
    """Return a ring lying flat: radius of its middle line and of its round section [m]."""
    return Profile("torus", ring_radius, ring_radius, tube_radius)


def punch(radius: float, edge_radius: float) -> Profile:
    """Return a flat round punch with a rounded edge [m]."""
    return Profile("punch", 0.0, radius - edge_radius, edge_radius)


def tube(outer_radius: float, inner_radius: float, edge_radius: float) -> Profile:
    """Return a flat ring with rounded edges [m]."""
    return Profile("tube", inner_radius + edge_radius, outer_radius - edge_radius, edge_radius)


def cone(half_angle: float, rounding: float, flat: float = 0.0) -> Profile:
    """Return a cone [rad] on a tangent spherical tip [m], or on a `flat` end within it [m]."""
    return Profile("cone", 0.0, flat, rounding, half_angle)
