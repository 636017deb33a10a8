"""The `layer` tier: linear elastic, a few milliseconds a step."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from sim.errors import SceneError
from sim.layer.frames import Frames
from sim.layer.grid import Grid
from sim.layer.press import Press, precision
from sim.result import Result
from sim.scene import Scene

GRID = 128
"""Pixels along the longer side: on a body of 20 mm, forces of spheres within 0.1 %."""
TOLERANCE = 2e-3
"""Natural residual of the contact: moves forces by some 1e-4."""

Progress = Callable[[float], None]


def simulate_layer(
    scene: Scene,
    *,
    grid: int = GRID,
    tolerance: float = TOLERANCE,
    progress: Progress | None = None,
) -> Result:
    """Simulate one scene with small strains on an infinite layer, sides and all beyond left out.

    Args:
        scene: Friction and viscosity that relaxes all are known, mass is not.
        grid: Pixels along the body's longer side, 16 to 512.
        tolerance: Residual of the contact to reach, 1e-10 to 0.1 (`Contact.residual`).
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: An effect, a body or a setting that this tier does not have.
        SimulationDiverged: A step for which no contact was found.
    """
    check_known(scene, tolerance)
    began = time.perf_counter()
    press = Press(scene, Grid(scene.body, grid), tolerance)
    frames = Frames(scene, press)
    ready = time.perf_counter()
    moving = 0.0
    before = 0.0
    for frame, (tip, now) in enumerate(zip(scene.motion.tip, scene.motion.time, strict=True)):
        start = time.perf_counter()
        press.move(np.array(tip), now - before)
        moving += time.perf_counter() - start
        before = now
        frames.keep(frame)
        if progress is not None:
            progress((frame + 1) / len(scene.motion))
    whole = time.perf_counter() - ready
    return frames.result(
        {
            "tier": "layer",
            "mesh": {"grid": list(press.grid.shape), "period": list(press.grid.period)},
            "precision": np.dtype(precision(tolerance)).name,
            "device": "cpu",
            "tolerance": tolerance,
            "effects": list(scene.effects.key),
            "seconds": {
                "build": round(ready - began, 4),
                "contact": round(moving, 4),
                "frames": round(whole - moving, 4),
            },
        }
    )


def check_known(scene: Scene, tolerance: float) -> None:
    """Refuse what this tier does not have.

    Raises:
        SceneError: An effect or a tolerance that is not known.
    """
    effects = scene.effects
    for name in ("inertia", "gravity"):
        if getattr(effects, name) is not None:
            raise SceneError(
                f"effects.{name}: {getattr(effects, name)!r}; allowed with tier 'layer': None (it "
                "has no mass; 'fem' has)"
            )
    if effects.viscosity is not None and effects.viscosity.relaxes != "all":
        raise SceneError(
            f"viscosity.relaxes: {effects.viscosity.relaxes!r}; allowed with tier 'layer': 'all' "
            "('fem' has both)"
        )
    if not 1e-10 <= tolerance <= 0.1:
        raise SceneError(f"tolerance: {tolerance!r}; allowed: 1e-10 to 0.1")
