"""One contact problem: pressure that never pulls, friction that never exceeds its share of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.layer.convolution import Elastic
from sim.layer.descent import Problem, descend

Array = NDArray[np.floating[Any]]

ITERATIONS = 300
"""Iterations of one descent; 10 are usual, 30 from nothing."""
TURNS = 200
"""Turns between normal and tangential contact; 2 to 4 are usual."""
SHARE = 0.1
"""How far below the residual it met a descent goes: the other one will move its goal again."""
STALLED = 0.8
"""A turn that leaves more than this of the residual has overshot."""
DAMPED, DAMPED_MOST = 0.6, 0.05
"""What is left of the share of the new shear that is taken, each time; and its least."""
TINY = 1e-30
"""Keeps 0 / 0 away where nothing presses [Pa]."""


@dataclass(frozen=True, slots=True)
class Contact:
    """The traction within a window of X by Y pixels, and how good it is."""

    traction: Array
    """On the body (3, X, Y) [Pa]; the normal component is never above 0."""
    residual: float
    """Natural residual of the pressure over its norm, or of the shear over the norm of the most
    that friction allows: the larger one."""
    iterations: int
    """Iterations of all descents."""


def solve_frictionless(body: Elastic, gap: Array, start: Array, *, tolerance: float) -> Contact:
    """The pressure that leaves no overlap, to a residual of `tolerance`.

    `gap` (X, Y) [m] is the gap that there would be without traction, `start` a guess of the
    traction (3, X, Y). At every pixel pressure >= 0, gap >= 0, and one of them is 0.
    """
    if gap.min() >= 0:
        return Contact(np.zeros_like(start), 0.0, 0)
    pressure = _pushing(-start[2])
    found = descend(
        Problem(body.answer.normal, _pushing, body.local_normal),
        pressure,
        gap + body.answer.normal(pressure),
        tolerance=tolerance,
        iterations=ITERATIONS,
    )
    traction = np.stack([np.zeros_like(gap), np.zeros_like(gap), -found.x])
    return Contact(traction, found.residual, found.iterations)


def solve_frictional(
    body: Elastic, gap: Array, slip: Array, coefficient: float, start: Array, *, tolerance: float
) -> Contact:
    """The pressure and shear that obey Coulomb's law, to a residual of `tolerance`.

    `slip` (2, X, Y) [m] is how far the body slides over the indenter in this step, as `gap`
    without any traction. Besides what holds without friction: |shear| <= coefficient * pressure,
    and where the body slips the shear opposes it and is equal to that. Normal and tangential
    contact are each the least of an energy; they take turns, each with the other's latest answer
    (Panagiotopoulos, Ingenieur-Archiv 44 (1975) 421), until both hold together. With much friction
    on a material that couples them strongly the turns overshoot and have to be damped.
    """
    if gap.min() >= 0:
        return Contact(np.zeros_like(start), 0.0, 0)
    answer = body.answer
    pressure = _pushing(-start[2])
    shear = _within(start[:2], coefficient * pressure)
    caused = answer.full(np.concatenate([shear, -pressure[None]]))
    gap, slip = gap - caused[2], slip + caused[:2]
    normal = Problem(answer.normal, _pushing, body.local_normal)
    iterations, share, before = 0, 1.0, np.inf
    for _ in range(TURNS):
        tangential = _tangential(body, coefficient * pressure)
        residuals = normal.residual(pressure, gap), tangential.residual(shear, slip)
        residual = max(residuals)
        if residual <= tolerance:
            break
        if residual > STALLED * before:
            share = max(DAMPED * share, DAMPED_MOST)
        before = residual
        goals = [max(SHARE * each, tolerance / 2) for each in residuals]
        pushed = descend(normal, pressure, gap, tolerance=goals[0], iterations=ITERATIONS)
        slip = slip + answer.shear_by_normal(pressure - pushed.x)
        pressure, gap = pushed.x, pushed.slope
        tangential = _tangential(body, coefficient * pressure)
        allowed = tangential.project(shear)
        slip = slip + answer.shear(allowed - shear)
        rubbed = descend(tangential, allowed, slip, tolerance=goals[1], iterations=ITERATIONS)
        rubbing = allowed + share * (rubbed.x - allowed)
        slip = slip + share * (rubbed.slope - slip)
        gap = gap - answer.normal_by_shear(rubbing - shear)
        shear = rubbing
        iterations += pushed.iterations + rubbed.iterations
    return Contact(np.concatenate([shear, -pressure[None]]), residual, iterations)


def _tangential(body: Elastic, bound: Array) -> Problem:
    return Problem(
        body.answer.shear,
        lambda shear: _within(shear, bound),
        body.local_shear,
        float(np.linalg.norm(bound)),
    )


def _pushing(pressure: Array) -> Array:
    return np.maximum(pressure, 0.0)


def _within(shear: Array, bound: Array) -> Array:
    length = np.sqrt(shear[0] ** 2 + shear[1] ** 2)
    inside: Array = shear * (bound / np.maximum(np.maximum(length, bound), TINY))
    return inside
