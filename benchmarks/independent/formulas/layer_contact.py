"""Rigid axisymmetric indenters on a layer, frictionless: exact within linear elasticity.

The pressure is represented by a density phi(t) on 0..a (a: contact radius). The surface under the
indenter has its shape if, for 0 <= t <= a,

    phi(t) + 2/pi int_0^a K(t, s) phi(s) ds = 2/pi (d - g(t)),
    K(t, s) = int_0^inf (L(k h) - 1) cos(k t) cos(k s) dk,

a Fredholm equation of the second kind (Lebedev & Ufliand, J. Appl. Math. Mech. 22 (1958) 442;
Hayes et al., J. Biomech. 5 (1972) 541), with L of `layer` and g(t) = t int_0^t z'(r) dr /
sqrt(t^2 - r^2) for an indenter of height z(r) above its tip. Then F = pi E* int_0^a phi dt. A
smooth indenter adds phi(a) = 0 (no infinite pressure at the edge), which ties d to a.

Both integrals use Gauss-Legendre rules, so the error decreases faster than any power of the number
of points. `points` is the number of t up to a/h = 10 and grows in proportion beyond, as does the
number of k: doubling it changes no force by more than 1e-12 for a/h up to 10 and 1e-10 for a/h up
to 80, at any nu up to 0.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import j0

from benchmarks.independent.formulas.half_space import reduced_modulus
from benchmarks.independent.formulas.layer import layer_deficit

Array = NDArray[np.float64]
Transform = Callable[[Array], Array]

# Beyond this k h, 1 - L is below 1e-17 and negligible.
_ALPHA_MAX = 24.0


@dataclass(frozen=True, slots=True)
class LinearLayer:
    """Infinite layer on a rigid base, and the resolution of the equation."""

    thickness: float
    """[m]."""
    modulus: float
    """[Pa]."""
    poisson: float
    points: int = 64

    @property
    def reduced(self) -> float:
        """E* [Pa]."""
        return reduced_modulus(self.modulus, self.poisson)


@dataclass(frozen=True, slots=True)
class LayerContact:
    """Solved contact, whose results are its properties and methods."""

    transform: Transform
    """g(t) of the indenter."""
    layer: LinearLayer
    depth: float
    """Depth of the tip below the undeformed surface [m]."""
    contact_radius: float
    """[m]."""
    points: Array
    """Gauss points t_i in 0..a (N,) [m]."""
    load: Array
    """phi(t_i) times the weight of its point, (N,) [m^2]."""

    @property
    def force(self) -> float:
        """Pressing force [N]: pi E* int phi dt."""
        return math.pi * self.layer.reduced * float(np.sum(self.load))

    def displacement(self, r: ArrayLike) -> Array:
        """Return the height of the surface above the undeformed plane at `r` from the axis [m].

        u_z = -int_0^inf L(k h) A(k) J0(k r) dk with A(k) = int_0^a phi(t) cos(k t) dt.
        """
        r = np.asarray(r, float)
        return np.reshape([self._displacement(float(value)) for value in r.ravel()], r.shape)

    def _displacement(self, r: float) -> float:
        # Half-space part, L = 1: int phi(t) dt / sqrt(r^2 - t^2) with t = r sin(angle).
        end = math.asin(self.contact_radius / r) if r > self.contact_radius else math.pi / 2
        angle, weight = gauss_rule(end, 64)
        t = r * np.sin(angle)
        k, weights = deficit_rule(self.layer, self.contact_radius + r)
        spectrum = -weights * (np.cos(np.multiply.outer(k, self.points)) @ self.load)
        bent = np.cos(np.multiply.outer(t, k)) @ spectrum
        density = 2 / math.pi * (self.depth - self.transform(t) - bent)
        return -float(np.sum(weight * density) + np.sum(j0(k * r) * spectrum))


def layer_punch(depth: float, radius: float, layer: LinearLayer) -> LayerContact:
    """Flat circular punch of `radius` [m], pressed in by `depth` [m].

    Raises:
        ValueError: The depth is not positive.
    """
    _require_depth(depth)
    return _Equation(radius, np.zeros_like, layer).contact(depth)


def layer_sphere(depth: float, radius: float, layer: LinearLayer) -> LayerContact:
    """True sphere of `radius` [m], pressed in by `depth` [m].

    Raises:
        ValueError: The depth is not positive, or the contact would pass the equator.
    """
    _require_depth(depth)

    def transform(t: Array) -> Array:
        return t * np.arctanh(t / radius)

    # The layer widens the contact compared with the half-space, where the search begins.
    limit = radius * (1 - 1e-6)
    guess = min(math.sqrt(radius * depth), limit)

    def excess(contact_radius: float) -> float:
        return _Equation(contact_radius, transform, layer).smooth_depth - depth

    low, high = guess / 2, min(1.5 * guess, limit)
    while excess(high) < 0:
        if high == limit:
            raise ValueError(f"depth: {depth!r} m; allowed: less, contact ends at {limit:.6g} m")
        low, high = high, min(1.5 * high, limit)
    found = float(brentq(excess, low, high, xtol=1e-15 * guess, rtol=1e-14))
    return _Equation(found, transform, layer).contact(depth)


class _Equation:
    """Integral equation at one contact radius, solved for d = 1 and for g."""

    def __init__(self, contact_radius: float, transform: Transform, layer: LinearLayer) -> None:
        self.transform, self.contact_radius, self.layer = transform, contact_radius, layer
        count = math.ceil(layer.points * max(1.0, contact_radius / (10 * layer.thickness)))
        self.points, self.weights = gauss_rule(contact_radius, count)
        k, weight = deficit_rule(layer, 2 * contact_radius)
        rows = np.append(self.points, contact_radius)
        waves = np.cos(np.multiply.outer(rows, k))
        kernel = -2 / math.pi * (waves * weight) @ waves[:-1].T * self.weights
        right = 2 / math.pi * np.stack([np.ones_like(rows), transform(rows)], axis=1)
        self.solution = np.linalg.solve(np.eye(count) + kernel[:-1], right[:-1])
        self.edge = right[-1] - kernel[-1] @ self.solution

    @property
    def smooth_depth(self) -> float:
        """Depth at which phi(a) = 0 [m]."""
        return float(self.edge[1] / self.edge[0])

    def contact(self, depth: float) -> LayerContact:
        density = depth * self.solution[:, 0] - self.solution[:, 1]
        return LayerContact(
            transform=self.transform,
            layer=self.layer,
            depth=depth,
            contact_radius=self.contact_radius,
            points=self.points,
            load=density * self.weights,
        )


def _require_depth(depth: float) -> None:
    if not depth > 0:
        raise ValueError(f"depth: {depth!r} m; allowed: above 0")


def gauss_rule(end: float, points: int) -> tuple[Array, Array]:
    """Return points and weights of the Gauss-Legendre rule over 0..end."""
    place, weight = leggauss(points)
    return end / 2 * (place + 1), end / 2 * weight


def deficit_rule(layer: LinearLayer, reach: float) -> tuple[Array, Array]:
    """Return wave numbers k and weights such that sum(weight f(k)) = int (1 - L(k h)) f(k) dk.

    The integral is over 0..inf, for f that oscillates no faster than cos(k reach), `reach` in m: a
    panel of 16 points spans at most 4 rad of it.
    """
    panels = math.ceil(_ALPHA_MAX * max(2.0, reach / layer.thickness / 4))
    width = _ALPHA_MAX / panels
    place, weight = gauss_rule(width, 16)
    alpha = np.ravel(width * np.arange(panels)[:, None] + place)
    fraction = np.tile(weight, panels) * layer_deficit(alpha, layer.poisson)
    return alpha / layer.thickness, fraction / layer.thickness
