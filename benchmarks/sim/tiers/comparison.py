"""`mpm` compared with finite elements and the authors' settings, on one sphere press."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from sim.errors import SimulationDiverged
from sim.indenters import sphere
from sim.mpm import AUTHORS_SPACING, AUTHORS_VOLUME, Mpm
from sim.mpm.solver import simulate_mpm
from sim.result import Result
from sim.scene import Body, Scene, press
from sim.tiers import simulate

Array = NDArray[np.float64]
Progress = Callable[[float], None]

RADIUS = 4e-3
DEPTHS = (0.5e-3, 1.0e-3, 1.5e-3)
# Force at `DEPTHS` on the paper's gel, frictionless [N]; two element families agree to 0.1 %.
FORCE = (0.2652, 0.9197, 1.9560)
# The same on the body of the released parameters, with elements of 0.5 mm [N].
FORCE_RELEASED = (0.2405, 0.7894, 1.618)
# At the last depth with full stick [N].
FORCE_STICKING = 2.185
RADII = (4e-3, 5e-3, 6e-3, 8e-3)
# Height of the surface at `RADII` around the deepest press [m], from the same elements.
UP = (0.0001e-3, 0.0439e-3, 0.0424e-3, 0.0097e-3)
# Tip speed in the paper, and in GenForce's released parameters [m/s].
SPEED = 10e-3
SPEED_RELEASED = 40e-3
# Effective body of the released parameters.
BODY_RELEASED = Body(size_x=25e-3, size_y=25e-3, thickness=5e-3)
# Particle spacing of the authors' presets [m].
SPACINGS = {"authors": 0.2e-3, "authors, as released": 0.25e-3}
# Directions in which `UP` holds: along the axes. The free sides let the diagonals move more.
ANGLES = np.arange(4) * np.pi / 2


@dataclass(frozen=True, slots=True)
class Row:
    """One way to solve the press, with its results and cost."""

    name: str
    force: tuple[float, ...]
    """Force at `DEPTHS`, positive when pushing [N]."""
    reference: tuple[float, ...]
    """Reference force, frictionless [N]."""
    force_rescaled: tuple[float, ...]
    """Force, corrected for the particle volume [N]."""
    up: tuple[float, ...]
    """Height of the surface at `RADII` at the last depth [m]."""
    outward: tuple[float, ...]
    """Outward displacement there [m]."""
    particles: int
    """0 for finite elements."""
    steps: int
    """0 for finite elements."""
    seconds: float
    """Wall time, with kernels compiled before."""
    cpu_seconds: float
    """CPU time of this process."""
    bytes: int
    """Size of all arrays on the device; 0 if not counted."""
    device: str
    warnings: tuple[str, ...] = ()


def sphere_scene(body: Body | None = None, *, speed: float = SPEED) -> Scene:
    """Return the press shared by all rows, frictionless; `speed` in [m/s]."""
    return Scene(sphere(RADIUS), press(DEPTHS, speed=speed), body=body or Body())


def choices(*, fine: bool = False) -> dict[str, tuple[Scene, Mpm]]:
    """Return the settings to compare by name: two presets of the authors, then ours by fineness."""
    paper = sphere_scene()
    found = {
        "authors": (paper, Mpm.authors()),
        "authors, as released": (
            sphere_scene(BODY_RELEASED, speed=SPEED_RELEASED),
            Mpm(published="genforce"),
        ),
    }
    cells = (0.5e-3, 0.4e-3, 0.25e-3) if fine else (0.5e-3, 0.4e-3)
    for cell in cells:
        found[f"cell {cell * 1e3:g} mm"] = paper, Mpm(cell=cell)
    return found


def measure(
    name: str,
    scene: Scene,
    numerics: Mpm,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Row:
    """Return the row of one choice.

    Raises:
        SimulationDiverged: No solution.
    """
    # Run the same kernels on a few particles first, so that compilation is not timed.
    tiny = Scene(sphere(RADIUS), press([1e-6], speed=SPEED), body=Body(4e-3, 4e-3, 4e-3))
    few = numerics if numerics.published else replace(numerics, cell=1e-3)
    simulate_mpm([tiny], few, device=device)
    wall, cpu = time.perf_counter(), time.process_time()
    outcome = simulate_mpm([scene], numerics, device=device, progress=progress)[0]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    record = outcome.record
    volume = 1.0
    if numerics.published is not None:
        # Volume per particle of the lattice, over the published one.
        volume = AUTHORS_SPACING[numerics.published] ** 3 / AUTHORS_VOLUME
    return _row(
        name,
        outcome,
        volume=volume,
        particles=record["particles"],
        steps=record["steps"],
        seconds=wall,
        cpu_seconds=cpu,
        bytes=record["bytes"],
        device=record["device"],
        warnings=tuple(record["warnings"]),
    )


def measure_elements(*, device: str = "cpu", progress: Progress | None = None) -> Row:
    """Return the row of the finite elements, with their default settings."""
    scene = sphere_scene()
    simulate(Scene(sphere(RADIUS), press([1e-6]), body=Body(4e-3, 4e-3, 4e-3)), device=device)
    wall, cpu = time.perf_counter(), time.process_time()
    result = simulate(scene, device=device, progress=progress)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return _row(
        "finite elements",
        result,
        volume=1.0,
        particles=0,
        steps=0,
        seconds=wall,
        cpu_seconds=cpu,
        bytes=0,
        device=device,
        warnings=tuple(result.record["warnings"]),
    )


def around(result: Result, radius: float) -> tuple[float, float]:
    """Return height and outward motion of the surface at this radius [m], mean over 4 sides."""
    axes = (result.surface_x, result.surface_y)
    field = RegularGridInterpolator(axes, result.surface[-1].astype(float))
    spokes = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    moved = field(radius * spokes)
    return float(moved[:, 2].mean()), float((moved[:, :2] * spokes).sum(axis=1).mean())


def _row(name: str, result: Result, *, volume: float, **cost: object) -> Row:
    force = -result.force[1:, 2]
    places = [around(result, radius) for radius in RADII]
    return Row(
        name=name,
        force=tuple(float(value) for value in force),
        reference=FORCE_RELEASED if result.scene.body == BODY_RELEASED else FORCE,
        force_rescaled=tuple(float(value) * volume for value in force),
        up=tuple(up for up, _ in places),
        outward=tuple(outward for _, outward in places),
        **cost,  # type: ignore[arg-type]
    )
