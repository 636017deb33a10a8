"""A body that leans: how it is turned, and how far its lowest point then lies below the origin."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.indenters.lower_surface import lower_surface

if TYPE_CHECKING:
    from sim.indenters.indenter import Indenter

Array = NDArray[np.float64]
Tilt = tuple[float, float]

UPRIGHT: Tilt = (0.0, 0.0)
TILT_MAX = math.radians(30)
"""Largest angle from upright [rad]."""
SPAN = 20e-3
"""How far from its axis the lowest point of a body without sides is looked for [m]."""
SEEDS = 41
"""Places along x and y from which it is."""
STRIDES = (0.2, 0.005)
"""Steps downwards, in half-widths of the body: far ones, then near ones, where distances are
exact."""
STEPS_MAX, RETURNS = 300, 6
"""Steps of each kind, and how often each is taken back along the normal."""
SETTLED, ON_SURFACE = 1e-13, 1e-10
"""Gain that ends the steps [m]; what counts as on the surface [m]."""


def rotation(tilt: Tilt) -> Array:
    """The matrix (3, 3) that turns by the rotation vector (about x, about y, 0) [rad].

    Rodrigues' formula; both angles at once, so that neither comes first.
    """
    angle = math.hypot(*tilt)
    if angle == 0:
        return np.eye(3)
    x, y = tilt[0] / angle, tilt[1] / angle
    across = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * across @ across
    return turn


def lowest(upright: Indenter, turn: Array) -> float:
    """Least z [m] of an upright body that is turned about the origin, to some nanometres.

    From wherever the body is lowest among its neighbours on a grid, a point slides on over the
    surface: a step straight down, and back along the normal, until that gains nothing.

    Raises:
        SceneError: A body without end, which has no lowest point when it leans.
    """
    x_side, y_side, _ = upright.bounds
    endless = not np.isfinite([x_side, y_side]).all()
    span = SPAN if endless else math.inf
    low, high = np.clip(np.transpose([x_side, y_side]), -span, span)
    half = float(max(np.abs(low).max(), np.abs(high).max()))
    points = _on_surface(upright, _seeds(upright, turn, (low, high), half))[0]
    found = points @ turn[2]
    for stride in STRIDES:
        for _ in range(STEPS_MAX):
            moved, gap = _on_surface(upright, points - stride * half * turn[2])
            below = moved @ turn[2]
            gained = (below < found - SETTLED) & (np.abs(gap) < ON_SURFACE)
            points[gained], found[gained] = moved[gained], below[gained]
            if not gained.any():
                break
    best = int(np.argmin(found))
    if endless and np.abs(points[best, :2]).max() > 0.9 * SPAN:
        raise SceneError(
            f"indenter {upright.name}.tilt: it has no lowest point when it leans; allowed: upright"
        )
    return float(found[best])


def _seeds(upright: Indenter, turn: Array, box: tuple[Array, Array], half: float) -> Array:
    """Places (N, 3) near the surface where the turned body is low, none of them left out.

    Columns are followed up to where they come as near to the body as to the next column, so that
    no spike stands unseen between them.
    """
    from scipy.ndimage import minimum_filter

    x, y = np.linspace(*box, SEEDS).T
    columns = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    near = math.hypot(x[1] - x[0], y[1] - y[0]) / 2

    def distance(index: NDArray[np.int64], height: Array) -> tuple[Array, Array]:
        gap, normal = upright.distance(np.column_stack([columns[index], height - near]))
        return gap - near, normal[:, 2]

    # What stands higher, even at the far corner, stays above the tip.
    tangent = math.sqrt(1 - turn[2, 2] ** 2) / turn[2, 2]
    reach = 2 * math.sqrt(2) * half * tangent + 2 * near
    places = np.column_stack([columns, lower_surface(distance, len(columns), reach) - near])
    drop = (places @ turn[2]).reshape(SEEDS, SEEDS)
    low = (drop == minimum_filter(drop, 3)) & np.isfinite(drop)
    seeds: Array = places[low.ravel()]
    return seeds


def _on_surface(upright: Indenter, points: Array) -> tuple[Array, Array]:
    """Points (N, 3) taken back to the surface along its normal, and the gap that is left (N,)."""
    gap = np.zeros(len(points))
    for _ in range(RETURNS):
        gap, normal = upright.distance(points)
        points = points - gap[:, None] * normal
    return points, gap
