"""An indenter: a fold of parts, and the signed distance to it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.checks import check_range
from sim.errors import SceneError
from sim.indenters.lower_surface import lower_surface
from sim.indenters.part import Bounds, Part

Array = NDArray[np.float64]

STEEPNESS_MIN = 0.1
"""Least gradient of a rounded edge: below it the faces are so nearly opposite that there is no
edge, and the nearer face alone counts."""


@dataclass(frozen=True, slots=True)
class Indenter:
    """A rigid body, tip down: its lowest point is the origin, the material is above (z up).

    The parts are joined in turn; every convex edge that an `intersect` or `subtract` makes, and
    every convex corner of a path, is rounded to `edge_radius`. Rounding takes material away beside
    the edge; faces and the tip plane stay where they are.

    Raises:
        SceneError: No part, a first part that is not a `union`, an edge radius that does not fit
            the narrowest part, or a lowest point that is not at z = 0.
    """

    name: str
    parts: tuple[Part, ...]
    edge_radius: float = 0.0
    """Radius of every convex edge [m], from 0 (sharp) to half the narrowest width."""
    narrowest: float = math.inf
    """Narrowest wall between two parts [m], such as between a recess and a side; the parts know
    their own widths."""

    def __post_init__(self) -> None:
        if not self.parts:
            raise SceneError(f"indenter {self.name}: no parts; allowed: 1 or more")
        if self.parts[0].join != "union":
            raise SceneError(
                f"indenter {self.name}.parts[0].join: {self.parts[0].join!r}; allowed: 'union', "
                "there is nothing before it"
            )
        owner = f"indenter {self.name}"
        if not self.narrowest > 0:
            raise SceneError(f"{owner}.narrowest: {self.narrowest!r} m; allowed: above 0, or inf")
        limit = self.edge_radius_max * (1 + 1e-9)  # 0.4 mm fits a wall of 3.5 - 2.7 mm
        check_range(owner, "edge_radius", self.edge_radius, 0.0, limit, unit="m")
        tip = self.bounds[2][0]
        if math.isfinite(tip) and abs(tip) > 1e-9:
            raise SceneError(
                f"{owner}: the rounded body's lowest point is at z = {tip:g} m; allowed: 0 (draw a "
                "round tip as an arc)"
            )

    @property
    def edge_radius_max(self) -> float:
        """Largest edge radius the shape has room for [m]."""
        return min(self.narrowest / 2, *(part.edge_radius_max for part in self.parts))

    @property
    def bounds(self) -> Bounds:
        """A box around the body: least and greatest x, y and z [m]; infinite where it is open."""
        box = self.parts[0].bounds(self.edge_radius)
        for part in self.parts[1:]:
            other = part.bounds(self.edge_radius)
            if part.join == "union":
                box = _sides(box, other, min, max)
            elif part.join == "intersect":
                box = _sides(box, other, max, min)
        return box

    def distance(self, points: ArrayLike) -> tuple[Array, Array]:
        """Gap and outward unit normal at points (..., 3) [m] in the indenter's frame.

        Returns:
            Gap (...,) [m], below 0 inside; normal (..., 3), the unit gradient of the gap. The
            surface is exact; away from it the gap is exact for single parts and edges at the angle
            of `Part.cosine`, elsewhere to first order.
        """
        given = np.asarray(points, np.float64)
        flat = given.reshape(-1, 3)
        alone = [part.distance(flat, self.edge_radius) for part in self.parts]
        gap, normal = self._joined(alone)
        return gap.reshape(given.shape[:-1]), normal.reshape(given.shape)

    def heights(self, x: ArrayLike, y: ArrayLike, *, reach: float = 10e-3) -> Array:
        """Height of the lower surface above the tip plane at x, y (broadcast together) [m].

        inf where there is no surface below `reach` [m]. Exact to 1e-9 m; a slit of material less
        than 1/2000 of `reach` high may be missed.
        """
        plan = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        columns = np.stack([axis.ravel() for axis in plan], axis=1)
        low, high = np.transpose(self.bounds[:2])
        inside = np.flatnonzero(((columns >= low) & (columns <= high)).all(axis=1))
        heights = np.full(len(columns), np.inf)
        heights[inside] = self._column_heights(columns[inside], reach)
        return heights.reshape(plan[0].shape)

    def _column_heights(self, columns: Array, reach: float) -> Array:
        """`heights` of columns (N, 2); what does not change along z is computed once."""
        ground = np.column_stack([columns, np.zeros(len(columns))])
        upright = {
            part: part.distance(ground, self.edge_radius)
            for part in self.parts
            if part.view == "plan"
        }

        def distance(index: NDArray[np.int64], height: Array) -> tuple[Array, Array]:
            points = np.column_stack([columns[index], height])
            alone = [
                (upright[part][0][index], upright[part][1][index])
                if part in upright
                else part.distance(points, self.edge_radius)
                for part in self.parts
            ]
            gap, normal = self._joined(alone)
            return gap, normal[:, 2]

        return lower_surface(distance, len(columns), reach)

    def _joined(self, alone: list[tuple[Array, Array]]) -> tuple[Array, Array]:
        """Gap (N,) and normal (N, 3) of the whole, from those of each part alone."""
        gap, normal = alone[0]
        for part, (other, other_normal) in zip(self.parts[1:], alone[1:], strict=True):
            if part.join == "union":
                nearer = other < gap
                gap = np.where(nearer, other, gap)
                normal = np.where(nearer[:, None], other_normal, normal)
                continue
            if part.join == "subtract":
                other, other_normal = -other, -other_normal
            gap, normal = _intersection(
                gap, normal, other, other_normal, self.edge_radius, part.cosine
            )
        return gap, normal


def _sides(
    box: Bounds, other: Bounds, low: Callable[..., float], high: Callable[..., float]
) -> Bounds:
    x, y, z = (
        (low(mine[0], its[0]), high(mine[1], its[1])) for mine, its in zip(box, other, strict=True)
    )
    return x, y, z


def _intersection(
    gap: Array, normal: Array, other: Array, other_normal: Array, radius: float, cosine: float
) -> tuple[Array, Array]:
    """Gap and normal of what two bodies share, the edge between them rounded to `radius`.

    Let a and b be the distances from the faces shifted inwards by the radius, and c the cosine
    between their normals. Where the edge of the shifted faces is the nearest,

        d^2 = (a^2 + b^2 - 2 c a b) / (1 - c^2)

    is the distance from it (the law of cosines), and d - radius the gap: an arc, tangent to both
    faces. Where the true cosine differs from c the gradient of d is not of length 1: the gap is
    divided by that length, which keeps the surface and makes the gap right to first order.
    """
    a, b = gap + radius, other + radius
    along_a, along_b = a - cosine * b, b - cosine * a
    sine2 = 1 - cosine * cosine
    length = np.sqrt(np.maximum(a * along_a + b * along_b, 0) / sine2)
    edge = (along_a > 0) & (along_b > 0) & (length > 0)
    scale = sine2 * np.where(edge, length, 1.0)
    gradient = (along_a / scale)[:, None] * normal + (along_b / scale)[:, None] * other_normal
    steepness = np.sqrt(np.einsum("ij,ij->i", gradient, gradient))
    edge &= steepness > STEEPNESS_MIN
    steepness = np.where(edge, steepness, 1.0)
    nearer = other > gap
    face, face_normal = (
        np.where(nearer, other, gap),
        np.where(nearer[:, None], other_normal, normal),
    )
    return (
        np.where(edge, (length - radius) / steepness, face),
        np.where(edge[:, None], gradient / steepness[:, None], face_normal),
    )
