"""Changes of force, markers and time by each effect of a scene, measured on a coarse mesh.

The scene is solved on one coarse `fem` mesh with all of its effects, and again with each of them
at no strength. All are one batch of the same kernels, steps and mesh, whose own error mostly
cancels in the differences.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim.device import check_device
from sim.errors import SimulationDiverged, check_kind
from sim.fem import Fem
from sim.fem.stepping import path_of
from sim.metrics import force_errors, marker_errors, outcome_of
from sim.result import Outcome, Result
from sim.scene import Effects, Scene
from sim.tiers import simulate_many

# Elements through the thickness. States are solved to a thousandth of the force, and a press that
# is too hard for the limits is given up: it would take longer than the scene is worth.
LAYERS = 4
COARSE = Fem(tolerance=1e-3, path_tolerance=1e-2, newton_max=30, cg_max=1500, halvings=3)
# Uncertainty of a change: this fraction of it, and at least as much as two states that are solved
# to a thousandth may differ; of the force and of the markers [px].
UNSURE, LEAST_FORCE, LEAST_MARKER = 0.5, 1e-3, 0.02
# Iterations of the linear solver that take as long as the rest of one Newton iteration.
NEWTON = 50


@dataclass(frozen=True, slots=True)
class EffectSize:
    """Change by leaving one effect out of a scene; None: unknown."""

    name: str
    """`friction`, `viscosity`, `inertia` or `gravity`."""
    force: float | None = None
    """Largest change of the force along x, y or z in a frame, over `sim.result.force_scale`."""
    force_unsure: float | None = None
    """Uncertainty of `force`."""
    marker: float | None = None
    """Root mean square of the distances between 14 x 14 markers' images, largest frame [px]."""
    marker_unsure: float | None = None
    """Uncertainty of `marker` [px]."""
    time: float | None = None
    """Estimated fraction of the scene's time that the effect takes; negative if it saves time."""
    why: str = ""
    """Reason why changes are unknown, or why there is none."""


@dataclass(frozen=True, slots=True)
class EffectsTable:
    """Changes by each active effect of a scene; printed, it is a table."""

    sizes: tuple[EffectSize, ...]
    """Active effects in the order of `Effects.key`."""
    seconds: float
    """Time that the table took [s]."""

    def record(self) -> dict[str, Any]:
        """Return the table as plain JSON values."""
        each = [{name: getattr(one, name) for name in one.__slots__} for one in self.sizes]
        return {"effects": each, "seconds": round(self.seconds, 4)}

    def __str__(self) -> str:
        """Return a row for each effect of `sim`, those that are off too, and how it is known."""
        by_name = {one.name: one for one in self.sizes}
        rows = [("effect", "force", "markers", "time", "")]
        for name in Effects.__slots__:
            one = by_name.get(name)
            if one is None:
                rows.append((name, "-", "-", "0 %", "off"))
                continue
            force = _with_error(one.force, one.force_unsure, 100, "%")
            marker = _with_error(one.marker, one.marker_unsure, 1, "px")
            time_ = "?" if one.time is None else f"{100 * one.time:.0f} %"
            rows.append((name, force, marker, time_, one.why))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        return "\n".join(
            [*lines, f"changes by leaving one out; a coarse mesh, {self.seconds:.1f} s"]
        )


def _with_error(value: float | None, error: float | None, factor: float, unit: str) -> str:
    if value is None or error is None:
        return "?"
    if value <= error:
        return f"< {factor * (value + error):.1g} {unit}"
    return f"{factor * value:.2g} +- {factor * error:.1g} {unit}"


def effects_table(
    scene: Scene, *, device: str = "cpu", progress: Callable[[float], None] | None = None
) -> EffectsTable:
    """Return what each effect changes: force, markers and time.

    Args:
        scene: Scene with the effects in question.
        device: Device of the coarse mesh, `cpu` or `cuda:0` and the like.
        progress: Called with the fraction done, 0 to 1.

    Raises:
        SceneError: The device does not exist, or `scene` is no Scene.
    """
    check_kind("scene", scene, Scene, "a Scene")
    check_device(device)
    began = time.perf_counter()
    active = [
        name
        for name in scene.effects.key
        if getattr(scene.effects, name) != getattr(scene.effects, name).weakened(0.0)
    ]
    numerics = replace(COARSE, spacing=scene.body.thickness / LAYERS)
    without = [
        replace(scene, effects=replace(scene.effects, **{name: weak}))
        for name in active
        for weak in [getattr(scene.effects, name).weakened(0.0)]
    ]
    outcomes: list[Outcome] = []
    if active:
        outcomes = simulate_many([scene, *without], numerics, device=device, progress=progress)
    by_name = dict(zip(active, outcomes[1:], strict=True))
    sizes = [
        _size(scene, name, outcomes[0], by_name[name], numerics)
        if name in by_name
        else EffectSize(name, 0.0, 0.0, 0.0, 0.0, None, "of no strength")
        for name in scene.effects.key
    ]
    return EffectsTable(tuple(sizes), time.perf_counter() - began)


def _size(scene: Scene, name: str, full: Outcome, less: Outcome, numerics: Fem) -> EffectSize:
    """Return the difference between the scene and the one without the effect."""
    if isinstance(full, SimulationDiverged) or isinstance(less, SimulationDiverged):
        return EffectSize(name, why="no solution on the coarse mesh")
    force, marker = changes(full, less)
    off = replace(scene, effects=replace(scene.effects, **{name: None}))
    steps = path_of(off, numerics).steps / path_of(scene, numerics).steps
    size = EffectSize(
        name,
        marker=marker,
        marker_unsure=max(UNSURE * marker, LEAST_MARKER),
        time=1.0 - steps * _work(less) / _work(full),
    )
    if not full.force.any():
        return replace(size, why="no contact on the coarse mesh")
    return replace(size, force=force, force_unsure=max(UNSURE * force, LEAST_FORCE))


def changes(full: Result, less: Result) -> tuple[float, float]:
    """Return `EffectSize.force` and `.marker` of two results, with all effects and without one."""
    one, reference = outcome_of(less), outcome_of(full)
    pixels = marker_errors(one, reference, full.scene.body)
    force = float(force_errors(one, reference)[1].max())
    return force, float(np.sqrt(np.mean(pixels**2, axis=1)).max())


def _work(result: Result) -> float:
    return float(result.quality.cg.sum() + NEWTON * result.quality.newton.sum())
