"""Changes of force, markers and time by each effect of a scene, measured on a coarse mesh.

The scene is solved on one coarse `fem` mesh with all of its effects, again with each of them at no
strength, and with all of them a thousandth weaker. All are one batch of the same kernels, steps and
mesh, whose own error mostly cancels in the differences. The last one shows how far solutions of
this scene differ without a reason, as they do where contact at edges depends on the path.
"""

import time
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sim.arrays import Progress
from sim.device import check_device
from sim.errors import SimulationDiverged, check_kind
from sim.fem import Fem
from sim.fem.mesh import contact_window, meshes_of
from sim.fem.outcome import checked
from sim.fem.sizing import ACROSS, OVER_DEPTH, Sizes, Span
from sim.fem.solver import solve_on_meshes
from sim.fem.stepping import path_of
from sim.metrics import force_errors, marker_errors, outcome_of
from sim.result import Outcome, Result
from sim.scene import Effects, Motion, Scene

# Fineness of the mesh, as in `Fem`: the first with which the product of elements, steps and
# solutions is within `WORK`, which takes a second; and least width of a contact, in thicknesses.
FINENESS, WORK, LEAST_WIDTH = (0.4, 0.33, 0.27, 0.22, 0.18, 0.14, 0.1), 25_000, 0.02
# Longest step of the tip, in thicknesses, and about the most frames along straight lines.
TRAVEL, FRAMES = 1 / 8, 6
# A press that is too hard for these limits is given up: it would take longer than the table may.
LIMITS = Fem(
    precision="float32",
    tolerance=2e-3,
    path_tolerance=0.1,
    augmentations=1,
    newton_max=20,
    cg_max=1500,
    halvings=2,
)
# Strength of the effects that should change nothing, and the multiple of that change, and fraction
# of its own one, of which a change is unsure; at least as much as tolerances of states allow. The
# fraction grows with the square of the elements where the mesh is coarser than this fineness.
HARDLY, SPREAD, UNSURE, RESOLVED = 0.999, 3.0, 0.4, 0.3
LEAST_FORCE, LEAST_MARKER = 5e-3, 0.02
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
    """Uncertainty of `force`, an estimate: most changes are within it, not all."""
    marker: float | None = None
    """Root mean square of the distances between 14 x 14 markers' images, largest frame [px]."""
    marker_unsure: float | None = None
    """Uncertainty of `marker` [px], as that of `force`."""
    time: float | None = None
    """Fraction of the scene's time that the effect takes, roughly, by steps and iterations;
    negative if it saves time."""
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
        """Return a row for each effect, those that are off too, and how it is known."""
        by_name = {one.name: one for one in self.sizes}
        rows = [("effect", "force", "markers", "time", "")]
        for name in Effects.__slots__:
            one = by_name.get(name)
            if one is None:
                rows.append((name, "0 %", "0 px", "0 %", "off"))
                continue
            force = _with_error(one.force, one.force_unsure, 100, "%")
            marker = _with_error(one.marker, one.marker_unsure, 1, "px")
            part = "?" if one.time is None else f"{100 * one.time:z.0f} %"
            rows.append((name, force, marker, part, one.why))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        known = f"changes without each, by a coarse mesh; times estimated; {self.seconds:.1f} s"
        return "\n".join([*lines, known])


def _with_error(value: float | None, error: float | None, factor: float, unit: str) -> str:
    if value is None or error is None:
        return "?"
    if 0 < value <= error:
        return f"< {float(f'{factor * (value + error):.1g}'):g} {unit}"
    plain, unsure = float(f"{factor * value:.2g}"), float(f"{factor * error:.1g}")
    return f"{plain:g} +- {unsure:g} {unit}" if value else f"0 {unit}"


def effects_table(
    scene: Scene, *, device: str = "cpu", progress: Progress | None = None
) -> EffectsTable:
    """Return the changes by each effect of a scene: of force, markers and time.

    They are solved on a coarse mesh; `progress` is called with the fraction done, 0 to 1.

    Raises:
        SceneError: The device does not exist, or `scene` is no Scene.
    """
    check_kind("scene", scene, Scene, "a Scene")
    check_device(device)
    began = time.perf_counter()
    brief = replace(scene, motion=_brief(scene.motion))
    scenes = variants(brief)
    outcomes: dict[str, Outcome] = {}
    settings, sizes = _coarse(brief, len(scenes))
    if len(scenes) > 2:
        meshed = [sizes] * len(scenes)
        some = solve_on_meshes([*scenes.values()], settings, meshed, device, progress)
        outcomes = dict(zip(scenes, map(checked, some), strict=True))
        for one in outcomes.values():
            if isinstance(one, SimulationDiverged):
                one.forget_dump()
    each = [
        _size(scene, name, outcomes, settings.fineness, sizes.x[0].size)
        if name in outcomes
        else EffectSize(name, 0.0, 0.0, 0.0, 0.0, why="of no strength")
        for name in scene.effects.key
    ]
    return EffectsTable(tuple(each), time.perf_counter() - began)


def variants(scene: Scene) -> dict[str, Scene]:
    """Return `all` of a scene, `hardly` the same, and the scene with each effect at no strength.

    Effects that have none are left out.
    """
    effects = {name: getattr(scene.effects, name) for name in scene.effects.key}
    weak = {name: weakened(one, 0.0) for name, one in effects.items()}
    changed = {"all": {}, "hardly": {name: weakened(one, HARDLY) for name, one in effects.items()}}
    changed |= {name: {name: weak[name]} for name in effects if effects[name] != weak[name]}
    return {
        name: replace(scene, effects=replace(scene.effects, **some))
        for name, some in changed.items()
    }


def weakened(effect: Any, fraction: float) -> Any:
    """Return an effect whose strength, its first field, is scaled; at 0 it vanishes."""
    name = fields(effect)[0].name
    strength = fraction * np.array(getattr(effect, name))
    return replace(effect, **{name: strength.tolist()})


def _brief(motion: Motion) -> Motion:
    """Return the motion with all of its corners, and about `FRAMES` waypoints between them."""
    tip, times = np.array(motion.tip), np.array(motion.time)
    velocity = np.diff(tip, axis=0) / np.diff(times)[:, None]
    turned = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    turns = turned > 1e-6 * np.abs(velocity).max(initial=0.0)
    some = range(0, len(tip), -(-len(tip) // FRAMES))
    kept = sorted({*some, *(1 + np.flatnonzero(turns)).tolist(), len(tip) - 1})
    return Motion(tuple(motion.tip[k] for k in kept), tuple(motion.time[k] for k in kept))


def _coarse(scene: Scene, solutions: int) -> tuple[Fem, Sizes]:
    """Return the settings of the finest mesh that is within `WORK`, or the coarsest, and its sizes.

    All that the indenter covers is meshed as a contact, without a look at the contact itself.
    """
    x, y = contact_window(scene, 0.0)
    narrow = max(min(x[1] - x[0], y[1] - y[0]), LEAST_WIDTH * scene.body.thickness)
    size = narrow / ACROSS
    sizes = Sizes((Span(*x, size),), (Span(*y, size),), OVER_DEPTH * size, narrow)
    for fineness in FINENESS:
        settings = replace(LIMITS, fineness=fineness, step_travel=TRAVEL * scene.body.thickness)
        (mesh,) = meshes_of([scene], settings, [sizes])
        steps = path_of(scene, settings, mesh.finest).steps
        if len(mesh.elements) * steps * solutions <= WORK:
            break
    return settings, sizes


def _size(
    scene: Scene, name: str, outcomes: dict[str, Outcome], fineness: float, side: float
) -> EffectSize:
    """Return the change by leaving an effect out of the scene, and the time that it takes.

    `side` is that of elements at fineness 1 [m].
    """
    solved: list[Result] = []
    for one in (outcomes["all"], outcomes["hardly"], outcomes[name]):
        if isinstance(one, SimulationDiverged):
            return EffectSize(name, why=f"no coarse solution: {one.reason.partition(':')[0]}")
        solved.append(one)
    full, hardly, less = solved
    (force, marker), (noise, noise_marker) = changes(full, less), changes(full, hardly)
    unsure = UNSURE * max(1.0, RESOLVED / fineness) ** 2
    finest = side / Fem().fineness / scene.body.thickness
    off = replace(scene, effects=replace(scene.effects, **{name: None}))
    steps = path_of(off, Fem(), finest).steps / path_of(scene, Fem(), finest).steps
    size = EffectSize(
        name,
        marker=marker,
        marker_unsure=max(unsure * marker, SPREAD * noise_marker, LEAST_MARKER),
        time=1.0 - steps * _work(less) / _work(full),
    )
    if not full.force.any():
        return replace(size, why="no contact")
    return replace(size, force=force, force_unsure=max(unsure * force, SPREAD * noise, LEAST_FORCE))


def changes(full: Result, less: Result) -> tuple[float, float]:
    """Return `EffectSize.force` and `.marker` of two results, with all effects and without one."""
    one, reference = outcome_of(less), outcome_of(full)
    pixels = marker_errors(one, reference, full.scene.body)
    force = float(force_errors(one, reference)[1].max())
    return force, float(np.sqrt(np.mean(pixels**2, axis=1)).max())


def _work(result: Result) -> float:
    return float(result.quality.cg.sum() + NEWTON * result.quality.newton.sum())
