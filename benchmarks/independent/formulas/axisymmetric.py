"""Rigid axisymmetric indenters on a layer, frictionless: exact within linear elasticity.

The pressure is represented by a density phi(t) on 0..a (a: contact radius). The surface under the
indenter has its shape if, for 0 <= t <= a,

    phi(t) + 2/pi int_0^a K(t, s) phi(s) ds = 2/pi (d - g(t)),
    K(t, s) = int_0^inf (L(k h) - 1) cos(k t) cos(k s) dk,

a Fredholm equation of the second kind (Lebedev & Ufliand, J. Appl. Math. Mech. 22 (1958) 442;
Hayes et al., J. Biomech. 5 (1972) 541), with L of `bonded_layer` and g(t) = t int_0^t z'(r) dr /
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
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from benchmarks.independent.formulas.bonded_layer import Base
from benchmarks.independent.formulas.layer_contact import (
    LayerContact,
    Profile,
    deficit_rule,
    gauss_rule,
)

Array = NDArray[np.float64]


def layer_punch(
    depth: float,
    radius: float,
    thickness: float,
    modulus: float,
    poisson: float,
    *,
    base: Base = "bonded",
    points: int = 64,
) -> LayerContact:
    """Flat circular punch of `radius` [m], pressed in by `depth` [m].

    Raises:
        ValueError: The depth is not positive.
    """
    _require_depth(depth)
    flat = Profile(transform=np.zeros_like, slope=np.zeros_like)
    return _Equation(radius, flat, thickness, poisson, base, points).contact(depth, modulus)


def layer_paraboloid(
    depth: float,
    radius: float,
    thickness: float,
    modulus: float,
    poisson: float,
    *,
    base: Base = "bonded",
    points: int = 64,
) -> LayerContact:
    """Paraboloid of curvature 1/`radius` at its tip, Hertz' shape, pressed in by `depth` [m].

    Raises:
        ValueError: The depth is not positive.
    """
    shape = Profile(lambda t: t**2 / radius, lambda t: 2 * t / radius)
    guess = math.sqrt(radius * abs(depth))
    equation = partial(
        _Equation, profile=shape, thickness=thickness, poisson=poisson, base=base, points=points
    )
    return _smooth(equation, depth, guess, math.inf).contact(depth, modulus)


def layer_sphere(
    depth: float,
    radius: float,
    thickness: float,
    modulus: float,
    poisson: float,
    *,
    base: Base = "bonded",
    points: int = 64,
) -> LayerContact:
    """True sphere of `radius` [m], pressed in by `depth` [m].

    Raises:
        ValueError: The depth is not positive, or the contact would pass the equator.
    """

    def slope(t: Array) -> Array:
        part = t / radius
        result: Array = np.arctanh(part) + part / (1 - part**2)
        return result

    shape = Profile(lambda t: t * np.arctanh(t / radius), slope)
    limit = radius * (1 - 1e-6)
    guess = min(math.sqrt(radius * abs(depth)), limit)
    equation = partial(
        _Equation, profile=shape, thickness=thickness, poisson=poisson, base=base, points=points
    )
    return _smooth(equation, depth, guess, limit).contact(depth, modulus)


def layer_cone(
    depth: float,
    half_angle: float,
    thickness: float,
    modulus: float,
    poisson: float,
    *,
    base: Base = "bonded",
    points: int = 64,
) -> LayerContact:
    """Cone, `half_angle` [rad] from its axis to its side, pressed in by `depth` [m].

    Raises:
        ValueError: The depth is not positive.
    """
    steepness = math.pi / 2 / math.tan(half_angle)
    shape = Profile(lambda t: steepness * t, lambda t: np.full_like(t, steepness), steepness)
    guess = abs(depth) / steepness
    equation = partial(
        _Equation, profile=shape, thickness=thickness, poisson=poisson, base=base, points=points
    )
    return _smooth(equation, depth, guess, math.inf).contact(depth, modulus)


class _Equation:
    """Integral equation at one contact radius, solved for d = 1 and for g."""

    def __init__(
        self,
        contact_radius: float,
        profile: Profile,
        thickness: float,
        poisson: float,
        base: Base,
        points: int,
    ) -> None:
        self.profile, self.contact_radius = profile, contact_radius
        self.thickness, self.poisson, self.base = thickness, poisson, base
        count = math.ceil(points * max(1.0, contact_radius / (10 * thickness)))
        self.points, self.weights = gauss_rule(contact_radius, count)
        k, weight = deficit_rule(thickness, poisson, base, 2 * contact_radius)
        rows = np.append(self.points, contact_radius)
        waves = np.cos(np.multiply.outer(rows, k))
        kernel = -2 / math.pi * (waves * weight) @ waves[:-1].T * self.weights
        right = 2 / math.pi * np.stack([np.ones_like(rows), profile.transform(rows)], axis=1)
        self.solution = np.linalg.solve(np.eye(count) + kernel[:-1], right[:-1])
        self.edge = right[-1] - kernel[-1] @ self.solution

    @property
    def smooth_depth(self) -> float:
        """Depth at which phi(a) = 0 [m]."""
        return float(self.edge[1] / self.edge[0])

    def contact(self, depth: float, modulus: float) -> LayerContact:
        density = depth * self.solution[:, 0] - self.solution[:, 1]
        return LayerContact(
            profile=self.profile,
            thickness=self.thickness,
            modulus=modulus,
            poisson=self.poisson,
            base=self.base,
            depth=depth,
            contact_radius=self.contact_radius,
            points=self.points,
            load=density * self.weights,
            edge_density=float(depth * self.edge[0] - self.edge[1]),
        )


def _smooth(
    equation: Callable[[float], _Equation], depth: float, guess: float, limit: float
) -> _Equation:
    """Return the equation at the contact radius, at most `limit`, with phi(a) = 0 at `depth`."""
    _require_depth(depth)

    def excess(contact_radius: float) -> float:
        return equation(contact_radius).smooth_depth - depth

    # The layer widens the contact compared with the half-space, where the search begins.
    low, high = guess / 2, min(1.5 * guess, limit)
    while excess(high) < 0:
        if high == limit:
            raise ValueError(f"depth: {depth!r} m; allowed: less, contact ends at {limit:.6g} m")
        low, high = high, min(1.5 * high, limit)
    return equation(float(brentq(excess, low, high, xtol=1e-15 * guess, rtol=1e-14)))


def _require_depth(depth: float) -> None:
    if not depth > 0:
        raise ValueError(f"depth: {depth!r} m; allowed: above 0")
