"""Deformed surfaces to draw: synthetic, smooth or folded, and presses solved by `fem`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.indenters import named, sphere
from sim.result import Result
from sim.scene import Body, Effects, Friction, Scene, press
from sim.tiers import simulate

Array = NDArray[np.float64]

# Radius of a dent [m].
RADIUS = 3e-3


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
) -> RenderState:
    """Return a smooth dent of `depth` [m], with the skin pushed outwards and dragged `aside` [m].

    Points are denser at the dent, as in a mesh.
    """
    body = body or Body()
    x, y = _graded(body.size_x / 2, at[0]), _graded(body.size_y / 2, at[1])
    off_x, off_y = x[:, None] - at[0], y[None, :] - at[1]
    bell = np.exp(-(off_x**2 + off_y**2) / RADIUS**2)
    outwards = 0.35 * depth / RADIUS * bell
    surface = [
        outwards * off_x + aside[0] * bell,
        outwards * off_y + aside[1] * bell,
        -depth * bell,
    ]
    return RenderState("dent", body, x, y, np.stack(surface, axis=-1).astype(np.float32))


def fold() -> RenderState:
    """Return a sheet dragged over itself so far that part of it is behind another part."""
    body = Body()
    x = np.linspace(-body.size_x / 2, body.size_x / 2, 121)
    bell = np.exp(-((x / 2.5e-3) ** 2))[:, None] * np.ones(len(x))
    surface = np.stack([4.5e-3 * bell, 0 * bell, -1.5e-3 * bell], axis=-1)
    return RenderState("fold", body, x, x.copy(), surface.astype(np.float32))


def solved(device: str) -> list[RenderState]:
    """Solve a deep sphere, an off-centre prism, and a sheared cylinder with friction, by `fem`.

    Of the cylinder the frame is the one that is farthest aside, else the last.
    """
    sheared = Scene(
        named("cylinder"),
        press([0.8e-3], shear=0.8e-3, angle=0.6, steps=2),
        effects=Effects(friction=Friction(0.8)),
    )
    aside = int(np.abs(np.array(sheared.motion.tip)[:, :2]).sum(axis=1).argmax())
    scenes = [
        ("sphere R 4 mm, 1.5 mm deep", Scene(sphere(4e-3), press([1.5e-3])), -1),
        (
            "prism, 1 mm deep at (4, -4) mm",
            Scene(named("prism"), press([1e-3], at=(4e-3, -4e-3))),
            -1,
        ),
        ("cylinder, 0.8 mm deep, sheared 0.8 mm", sheared, aside),
    ]
    return [state_of(name, simulate(scene, device=device), frame) for name, scene, frame in scenes]


def state_of(name: str, result: Result, frame: int) -> RenderState:
    """Return one frame of a result."""
    body = result.scene.body
    return RenderState(name, body, result.surface_x, result.surface_y, result.surface[frame])


def _graded(half: float, middle: float) -> Array:
    """Return 61 points from -half to half, about three times as dense around `middle`."""
    fraction = np.linspace(-1, 1, 1220)
    density = 1 + 2 * np.exp(-((fraction * half - middle) ** 2) / (half / 3) ** 2)
    amount = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2)])
    return np.interp(np.linspace(0, 1, 61), amount / amount[-1], fraction) * half
