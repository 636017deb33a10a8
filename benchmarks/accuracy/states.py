"""Deformed surfaces to draw: synthetic, smooth or folded, and presses solved by `fem`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.fem import Fem
from sim.indenters import named, sphere
from sim.result import Result
from sim.scene import Body, Effects, Friction, Scene, press
from sim.tiers import simulate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RenderState:
    """One deformed surface."""

    name: str
    body: Body
    x: Array
    """x of the undeformed points (X,) [m]."""
    y: Array
    """y of the undeformed points (Y,) [m]."""
    surface: NDArray[np.float32]
    """Their displacement (X, Y, 3) [m]."""


def dent(
    body: Body | None = None,
    *,
    depth: float = 1.2e-3,
    at: tuple[float, float] = (0.0, 0.0),
    aside: tuple[float, float] = (0.0, 0.0),
    radius: float = 3e-3,
    points: int = 61,
) -> RenderState:
    """Return a smooth dent of `depth` [m], with the skin pushed outwards and dragged `aside` [m].

    Points are denser at the dent, as in a mesh.
    """
    body = Body() if body is None else body
    x = _graded(body.size_x / 2, at[0], points)
    y = _graded(body.size_y / 2, at[1], points)
    off_x, off_y = x[:, None] - at[0], y[None, :] - at[1]
    bell = np.exp(-(off_x**2 + off_y**2) / radius**2)
    outwards = 0.35 * depth / radius * bell
    surface = [
        outwards * off_x + aside[0] * bell,
        outwards * off_y + aside[1] * bell,
        -depth * bell,
    ]
    return RenderState("dent", body, x, y, np.stack(surface, axis=-1).astype(np.float32))


def fold(*, points: int = 121) -> RenderState:
    """Return a sheet dragged over itself so far that part of it is behind another part."""
    body = Body()
    x = np.linspace(-body.size_x / 2, body.size_x / 2, points)
    bell = np.exp(-((x / 2.5e-3) ** 2))[:, None] * np.ones(points)
    surface = np.stack([4.5e-3 * bell, 0 * bell, -1.5e-3 * bell], axis=-1)
    return RenderState("fold", body, x, x.copy(), surface.astype(np.float32))


def solved(*, spacing: float | None = None, device: str = "cpu") -> list[RenderState]:
    """Solve a deep sphere, an off-centre prism, and a sheared cylinder with friction, by `fem`.

    `spacing` is the element size [m].
    """
    scenes = {
        "sphere R 4 mm, 1.5 mm deep": Scene(sphere(4e-3), press([1.5e-3])),
        "prism, 1 mm deep at (4, -4) mm": Scene(named("prism"), press([1e-3], at=(4e-3, -4e-3))),
        "cylinder, 0.8 mm deep, sheared 0.8 mm": Scene(
            named("cylinder"),
            press([0.8e-3], shear=0.8e-3, angle=0.6, steps=2),
            effects=Effects(friction=Friction(0.8)),
        ),
    }
    numerics = Fem() if spacing is None else Fem(spacing=spacing)
    states = []
    for name, scene in scenes.items():
        result = simulate(scene, numerics, device=device)
        aside = np.abs(np.array(scene.motion.tip)[:, :2]).sum(axis=1)
        states.append(state_of(name, result, int(np.argmax(aside)) if "sheared" in name else -1))
    return states


def state_of(name: str, result: Result, frame: int) -> RenderState:
    """Return one frame of a result."""
    body = result.scene.body
    return RenderState(name, body, result.surface_x, result.surface_y, result.surface[frame])


def _graded(half: float, middle: float, points: int) -> Array:
    """Return points from -half to half, about three times as dense around `middle`."""
    fraction = np.linspace(-1, 1, 20 * points)
    density = 1 + 2 * np.exp(-((fraction * half - middle) ** 2) / (half / 3) ** 2)
    amount = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2)])
    return np.interp(np.linspace(0, 1, points), amount / amount[-1], fraction) * half
