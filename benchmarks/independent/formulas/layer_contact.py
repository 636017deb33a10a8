"""Solved contact of a rigid axisymmetric indenter with a layer: force, pressure, surface.

Everything follows from the density phi of `axisymmetric` and its cosine transform A(k).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray
from scipy.special import j0

from benchmarks.independent.formulas.bonded_layer import Base, layer_deficit
from benchmarks.independent.formulas.half_space import reduced_modulus

Array = NDArray[np.float64]

# Beyond this k h, 1 - L is below 1e-17 and negligible.
_ALPHA_MAX = 24.0


@dataclass(frozen=True, slots=True)
class Profile:
    """Indenter shape in the form used by the integral equation."""

    transform: Callable[[Array], Array]
    """g(t) [m] of `axisymmetric`; 0 at the axis."""
    slope: Callable[[Array], Array]
    """dg/dt."""
    slope_at_axis: float = 0.0
    """dg/dt at t = 0; nonzero for a sharp tip."""


@dataclass(frozen=True, slots=True)
class LayerContact:
    """Solved contact, whose results are its properties and methods."""

    profile: Profile
    thickness: float
    modulus: float
    poisson: float
    base: Base
    depth: float
    """Depth of the tip below the undeformed surface [m]."""
    contact_radius: float
    """[m]."""
    points: Array
    """Gauss points t_i in 0..a (N,) [m]."""
    load: Array
    """phi(t_i) times the weight of its point, (N,) [m^2]."""
    edge_density: float
    """phi(a) [m]: above 0 under a punch, 0 under a smooth indenter."""

    @property
    def force(self) -> float:
        """Pressing force [N]: pi E* int phi dt."""
        return math.pi * reduced_modulus(self.modulus, self.poisson) * float(np.sum(self.load))

    def pressure(self, r: ArrayLike) -> Array:
        """Return the contact pressure at distances `r` from the axis [Pa]; 0 outside.

        p = E*/2 (phi(a) / sqrt(a^2 - r^2) - int_r^a phi'(t) dt / sqrt(t^2 - r^2)). It is infinite
        at a punch's edge and at a cone's tip.
        """
        r = np.asarray(r, float)
        return np.reshape([self._pressure(float(value)) for value in r.ravel()], r.shape)

    def displacement(self, r: ArrayLike) -> Array:
        """Return the height of the surface above the undeformed plane at `r` from the axis [m].

        u_z = -int_0^inf L(k h) A(k) J0(k r) dk with A(k) = int_0^a phi(t) cos(k t) dt.
        """
        r = np.asarray(r, float)
        return np.reshape([self._displacement(float(value)) for value in r.ravel()], r.shape)

    def _pressure(self, r: float) -> float:
        if r >= self.contact_radius:
            return 0.0
        # Substituting t^2 = r^2 + v^2 removes the root: dt / sqrt(t^2 - r^2) = dv / t.
        leg = math.sqrt(self.contact_radius**2 - r**2)
        v, weight = gauss_rule(leg, 64)
        t = np.hypot(r, v)
        k, spectrum = self._spectrum(2 * self.contact_radius)
        slope = self.profile.slope(t) - np.sin(np.multiply.outer(t, k)) @ (k * spectrum)
        total = float(np.sum(weight * (slope - self.profile.slope_at_axis) / t))
        if self.profile.slope_at_axis:
            part = math.acosh(self.contact_radius / r) if r > 0 else math.inf
            total += self.profile.slope_at_axis * part
        half_modulus = reduced_modulus(self.modulus, self.poisson) / 2
        return half_modulus * (2 / math.pi * total + self.edge_density / leg)

    def _displacement(self, r: float) -> float:
        # Half-space part, L = 1: int phi(t) dt / sqrt(r^2 - t^2) with t = r sin(angle).
        end = math.asin(self.contact_radius / r) if r > self.contact_radius else math.pi / 2
        angle, weight = gauss_rule(end, 64)
        t = r * np.sin(angle)
        k, spectrum = self._spectrum(self.contact_radius + r)
        bent = np.cos(np.multiply.outer(t, k)) @ spectrum
        density = 2 / math.pi * (self.depth - self.profile.transform(t) - bent)
        return -float(np.sum(weight * density) + np.sum(j0(k * r) * spectrum))

    def _spectrum(self, reach: float) -> tuple[Array, Array]:
        """Return wave numbers k and (L(k h) - 1) A(k) dk, for sums with cos(k reach) or slower."""
        k, weight = deficit_rule(self.thickness, self.poisson, self.base, reach)
        return k, -weight * (np.cos(np.multiply.outer(k, self.points)) @ self.load)


def gauss_rule(end: float, points: int) -> tuple[Array, Array]:
    """Return points and weights of the Gauss-Legendre rule over 0..end."""
    place, weight = leggauss(points)
    return end / 2 * (place + 1), end / 2 * weight


def deficit_rule(thickness: float, poisson: float, base: Base, reach: float) -> tuple[Array, Array]:
    """Return wave numbers k and weights such that sum(weight f(k)) = int (1 - L(k h)) f(k) dk.

    The integral is over 0..inf, for f that oscillates no faster than cos(k reach), `reach` in m: a
    panel of 16 points spans at most 4 rad of it.
    """
    panels = math.ceil(_ALPHA_MAX * max(2.0, reach / thickness / 4))
    width = _ALPHA_MAX / panels
    place, weight = gauss_rule(width, 16)
    alpha = np.ravel(width * np.arange(panels)[:, None] + place)
    fraction = np.tile(weight, panels) * layer_deficit(alpha, poisson, base)
    return alpha / thickness, fraction / thickness
