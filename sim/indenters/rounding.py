"""Edge radius of a body from a file, and the thin parts that rounding removes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.arrays import Array

if TYPE_CHECKING:
    from sim.indenters.nearest import Nearest

# Edge radii among which one is chosen [m]; the first is that of most named indenters.
RADII = (0.3e-3, 0.2e-3, 0.15e-3, 0.1e-3, 0.05e-3)
# Radii with which the sharpest place of a smoother body is estimated [m].
LARGE = (2.4e-3, 1.2e-3, 0.6e-3)
# A radius leaves this share of the faces that press, and takes this length [m] off a part at most.
LEFT_LEAST, LENGTH_MOST = 0.42, 1e-3
# Depth of the press by whose pressure faces count [m].
DEPTH = 0.5e-3
# Points on the surface that may press, most on all its triangles, and first points that are tried.
POINTS, POINTS_MOST, FEW = 40_000, 1_000_000, 1_000
# Distance by which a ball may reach through the surface [m]: facets are no smooth surface.
THROUGH = 4e-6
# Share of the surface that is no edge.
SPECKS = 1e-3
# Length over radius beyond which more than an edge is removed: 1 / tan(half of 44 degrees).
EDGE = 2.5
# Radius of the ball that fits into an edge, over the edge's.
NEARLY = 0.95
# Iterations for the radius of the largest ball at a point.
SHRINKING = 8


@dataclass(frozen=True, slots=True)
class Surface:
    """Points on the part of a body that may press."""

    near: Nearest
    points: Array
    """Positions (N, 3) [m], evenly spread."""
    normals: Array
    """Outward unit normals (N, 3)."""
    apart: float
    """Mean distance of neighbouring points [m]."""
    reach: float
    """Height [m] above which points are only neighbours of those below."""

    @classmethod
    def of(cls, near: Nearest, vertices: Array, faces: NDArray[np.int32], reach: float) -> Surface:
        """Return points up to `reach` [m] on triangles (F, 3) of vertices (V, 3) [m]."""
        top = reach + LENGTH_MOST
        corners = vertices[faces[vertices[faces, 2].min(axis=1) < top]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=1)
        height = corners[:, :, 2]
        below = (top - height.min(axis=1)) / np.maximum(np.ptp(height, axis=1), 1e-12)
        pressing = float((area * np.clip(below, 0.0, 1.0)).sum())
        count = min(POINTS_MOST, round(POINTS * area.sum() / pressing))
        dice = np.random.default_rng(0)
        which = dice.choice(len(area), count, p=area / area.sum())
        u, v = dice.random((2, count))
        u, v = np.where(u + v > 1, 1 - u, u)[:, None], np.where(u + v > 1, 1 - v, v)[:, None]
        a, b, c = np.moveaxis(corners[which], 1, 0)
        points = a + u * (b - a) + v * (c - a)
        there = points[:, 2] < top
        normals = normal[which] / area[which, None]
        apart = math.sqrt(area.sum() / 2 / count)
        return cls(near, points[there], normals[there], apart, reach)

    def fits(self, radius: float, count: int = POINTS_MOST) -> NDArray[np.bool_]:
        """Return at which points (N,) a ball of that radius [m] within the body touches it.

        Parts that no ball touches are those that rounding to that radius removes.
        """
        points, normals = self.points[:count], self.normals[:count]
        length, _ = self.near.distance(points - radius * normals)
        return (length > radius - THROUGH) | (points[:, 2] > self.reach)

    def pressing(self, left: NDArray[np.bool_]) -> float:
        """Return the share of the faces that press at points (N,)."""
        pressure = np.maximum(DEPTH - self.points[:, 2], 0) * np.maximum(-self.normals[:, 2], 0)
        return float((pressure * left).sum() / max(pressure.sum(), 1e-300))

    def suits(self, radius: float) -> bool:
        """Return whether rounding to that radius [m] leaves most of each part that presses."""
        left = self.fits(radius)
        return self.pressing(left) > LEFT_LEAST and bool((self._off(left) < LENGTH_MOST).all())

    def sharpest(self) -> float:
        """Return a radius [m] of a ball that touches all of the body from within, 0 at an edge."""
        for radius in (*LARGE, *RADII):
            ball = NEARLY * radius
            smooth = self.fits(ball, FEW).mean() > 1 - SPECKS
            if smooth and (radius in LARGE or self.fits(ball).mean() > 1 - SPECKS):
                return radius
        return 0.0

    def removed(self, radius: float) -> tuple[float, float]:
        """Return thickness and length [m] of the thin parts that rounding removes; 0, 0 if none.

        The thickness is twice the radius of the largest ball that touches a part from within.
        Beside an edge, that radius grows towards the rest of the body.
        """
        left = self.fits(radius)
        points, normals, off = self.points[~left], self.normals[~left], self._off(left)
        ball, going = np.full(len(points), radius), np.arange(len(points))
        for _ in range(SHRINKING):
            centre = points[going] - ball[going, None] * normals[going]
            length, away = self.near.distance(centre)
            chord = points[going] - centre + length[:, None] * away
            within = length < ball[going] - THROUGH
            going, chord = going[within], chord[within]
            aside = 2 * np.maximum(np.einsum("ij,ij->i", chord, normals[going]), 1e-12)
            ball[going] = np.minimum(ball[going], (chord**2).sum(axis=1) / aside)
        thin = off > EDGE * (radius - ball) + 3 * self.apart
        if thin.sum() <= SPECKS * len(left):
            return 0.0, 0.0
        return 2 * float(ball[thin].max()), float(off[thin].max())

    def _off(self, left: NDArray[np.bool_]) -> Array:
        """Return the distance [m] of each point that is removed from the rest of the body."""
        if not left.any():
            return np.full(len(left), np.inf)
        return np.asarray(cKDTree(self.points[left]).query(self.points[~left])[0])
