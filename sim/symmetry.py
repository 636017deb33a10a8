"""Symmetry check of results: a scene mirrored in a vertical plane allows no force across it.

If body, indenter, motion and gravity are their own image in a plane, so is the solution. A force
along the plane's normal, or a torque about a line in the plane, is then an error of the solver and
nothing else, known without a second solution. Or it is a state that is not symmetric, as of a soft
skin that gives way to one side under a blade: one of two that are equally right. Gravity across
the plane may decide for one, and explains a force of about the skin's weight, no more.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim.indenters import Indenter
from sim.metrics import force_scale
from sim.result import Result
from sim.scene import Scene

Array = NDArray[np.float64]
Normal = tuple[float, float]

# Possible mirror planes of a body, and their unit normals (x, y).
PLANES: dict[str, Normal] = {
    "x = 0": (1.0, 0.0),
    "y = 0": (0.0, 1.0),
    "x = y": (math.sqrt(0.5), -math.sqrt(0.5)),
    "x = -y": (math.sqrt(0.5), math.sqrt(0.5)),
}
# Distance of a waypoint from a plane, over the thickness, that counts as rounding.
OFF_PLANE = 1e-9
# Difference of an indenter from its image, over the depth of the press, that is ignored: it changes
# the force by as little.
ALIKE = 5e-3
# Points along x and y, and heights, at which an indenter is compared with its image: first a few,
# which find most asymmetric ones, then many.
COLUMNS, LEVELS = (10, 40), 6
# Fraction of the force above which there is a warning.
WORTH_SAYING = 0.01
NOTE = "the scene is its own image in the plane"
# Force across a plane that gravity explains, over the skin's weight along it: indenter and base
# share the weight.
EXPLAINED = 3.0


def planes_of(scene: Scene) -> tuple[str, ...]:
    """Return the mirror planes of a scene, as names of `PLANES`."""
    return tuple(name for name in _planes_but_for_gravity(scene) if not _pull(scene, name))


def _planes_but_for_gravity(scene: Scene) -> tuple[str, ...]:
    whole = len(scene.motion)
    return tuple(name for name, normal in PLANES.items() if _mirrored(scene, normal) == whole)


def vanishing_share(result: Result) -> Array:
    """Return the largest force across a mirror plane of the scene (F,), over the force.

    Over a tenth of the largest force if a frame's own is smaller; 0 without such a plane. A motion
    that leaves the plane has such forces only up to there. Later frames, on the same mesh, get the
    largest of them, as the error of a force along the skin. If gravity is across the plane, the
    force that it explains is subtracted.
    """
    across = np.zeros(len(result.wrench))
    for name in PLANES:
        count = _mirrored(result.scene, PLANES[name])
        if not count:
            continue
        forbidden = _across(result, name)[:count]
        across[:count] = np.maximum(across[:count], forbidden)
        across[count:] = np.maximum(across[count:], forbidden.max(initial=0.0))
    return across / force_scale(result.force)


def with_symmetry(result: Result) -> Result:
    """Return the `fem` result with `record["symmetry"]`, if its scene is mirrored in a plane.

    Keys: `plane`, the plane with the largest error; `vanishing_force_newton`, the largest force
    along its normal; `vanishing_torque_newton_metre`, the largest torque about the tip that it
    forbids; `percent`, the force over that of the frame, or over a tenth of the largest one. Above
    1 % there is a warning.
    """
    result = _with_note_beside_gravity(result)
    planes = planes_of(result.scene)
    if not planes:
        return result
    scale = force_scale(result.force)
    across = {name: np.abs(result.force[:, :2] @ PLANES[name]) for name in planes}
    plane = max(planes, key=lambda name: float((across[name] / scale).max(initial=0.0)))
    fraction = float((across[plane] / scale).max(initial=0.0))
    x, y = PLANES[plane]
    # A mirror reverses torques in its plane, so only a torque along its normal is allowed.
    forbidden = result.wrench[:, 3:] @ np.array([[-y, 0.0], [x, 0.0], [0.0, 1.0]])
    symmetry = {
        "plane": plane,
        "vanishing_force_newton": float(across[plane].max(initial=0.0)),
        "vanishing_torque_newton_metre": float(np.linalg.norm(forbidden, axis=1).max(initial=0.0)),
        "percent": 100 * fraction,
    }
    warnings = [one for one in result.record["warnings"] if not str(one).startswith(NOTE)]
    if fraction > WORTH_SAYING:
        warnings.append(
            f"{NOTE} {plane}, but {100 * fraction:.2g} % of the force is across it: the mesh, or a "
            "state that is not symmetric"
        )
    return replace(result, record={**result.record, "symmetry": symmetry, "warnings": warnings})


def _with_note_beside_gravity(result: Result) -> Result:
    """Return the result with a warning of forces across a plane that gravity does not explain."""
    scene, begins = result.scene, f"but for gravity {NOTE}"
    warnings = [one for one in result.record["warnings"] if not str(one).startswith(begins)]
    for name in _planes_but_for_gravity(scene):
        fraction = float((_across(result, name) / force_scale(result.force)).max(initial=0.0))
        if _pull(scene, name) and fraction > WORTH_SAYING:
            warnings.append(
                f"{begins} {name}, and {100 * fraction:.2g} % of the force is across "
                "it that gravity does not explain: the mesh, or a skin that gives way to one side "
                "and might as well to the other"
            )
    return replace(result, record={**result.record, "warnings": warnings})


def _across(result: Result, name: str) -> Array:
    """Return the size of each frame's force across a plane, beyond that by gravity (F,) [N]."""
    across = np.abs(result.force[:, :2] @ PLANES[name])
    return np.maximum(across - _pull(result.scene, name), 0.0)


def _pull(scene: Scene, name: str) -> float:
    """Return the force across a plane that gravity explains [N]; 0 if gravity is along it."""
    body, gravity = scene.body, scene.effects.gravity
    if gravity is None:
        return 0.0
    pull = np.asarray(gravity.acceleration, float)
    across = abs(float(pull[:2] @ PLANES[name]))
    if across <= OFF_PLANE * np.linalg.norm(pull):
        return 0.0
    return EXPLAINED * body.density * body.size_x * body.size_y * body.thickness * across


def _mirrored(scene: Scene, normal: Normal) -> int:
    """Return the number of waypoints up to which the scene is its image in a plane, but gravity."""
    body = scene.body
    if 0.0 not in normal and body.size_x != body.size_y:
        return 0
    limit = OFF_PLANE * body.thickness
    x, y, _ = scene.motion.tip[0]
    if abs(x * normal[0] + y * normal[1]) > limit:  # most scenes: no array is made for them
        return 0
    off = np.abs(np.asarray(scene.motion.tip)[:, :2] @ normal) > limit
    count = int(np.argmax(off)) if off.any() else len(off)
    if not count:
        return 0
    depth = scene.motion.depth_max
    if depth <= 0:
        return 0
    across = math.hypot(body.size_x, body.size_y)
    return count if asymmetry(scene.indenter, normal, depth, across) <= ALIKE * depth else 0


@functools.lru_cache(maxsize=4096)
def asymmetry(indenter: Indenter, normal: Normal, reach: float, across: float) -> float:
    """Return the difference of an indenter's surface from its image in a plane through its tip [m].

    The plane is vertical. The result is the largest difference of the signed distances at points
    and their images, among those closer to the surface than `reach`; or at only a few of them, if
    those already differ too much.

    Args:
        indenter: Indenter with the surface.
        normal: Unit normal (x, y) of the plane.
        reach: Largest height of the points [m].
        across: Largest distance of the points from the tip [m].
    """
    sides = np.abs(indenter.bounds_below(reach)[:2]).max(axis=1)
    half, found = np.minimum(sides, across), math.inf
    for columns in COLUMNS:
        found = _difference(indenter, normal, reach, half, columns)
        if ALIKE * reach < found < math.inf:
            break
    return found


def _difference(
    indenter: Indenter, normal: Normal, reach: float, half: Array, columns: int
) -> float:
    # Points are denser near the tip; none is on a plane of symmetry, where both sides agree.
    fraction = (np.arange(columns) + 0.5) / columns * 2 - 1
    fraction = fraction * np.abs(fraction)
    height = reach * np.linspace(0.0, 1.0, LEVELS)
    points = np.stack(np.meshgrid(fraction * half[0], fraction * half[1], height), -1).reshape(
        -1, 3
    )
    aside = points[:, :2] @ normal
    points, aside = points[aside > 0], aside[aside > 0]
    image = points.copy()
    image[:, :2] -= 2 * aside[:, None] * np.array(normal)
    here, there = indenter.distance(np.stack([points, image]))[0]
    near = np.minimum(np.abs(here), np.abs(there)) < reach
    return float(np.abs(here - there)[near].max()) if near.any() else math.inf
