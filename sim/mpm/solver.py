# mypy: ignore-errors
# Drives and reads Warp arrays, typed at run time; mypy cannot follow them.
"""Solver of the `mpm` tier: presses stepped through time, all of them in one batch."""

import time
from collections.abc import Sequence

import numpy as np
import warp as wp

from sim.arrays import Progress
from sim.device import check_device
from sim.errors import SceneError, SimulationDiverged
from sim.mpm import Mpm
from sim.mpm.lattice import QUASI_STATIC, Pace, build_lattice, pace_of
from sim.mpm.state import (
    COLLAPSED,
    LEFT_GRID,
    ROUND,
    SPEED_LIMIT,
    TOO_FAST,
    Means,
    ParticleState,
    Units,
)
from sim.result import Outcome, Quality, Result, no_quality
from sim.scene import Scene

# Values kept at the waypoints of a press: force, surface, and quality measures.

# Penetration is divided by the depth of the press, or by this if the depth is less [m].
DEPTH_LEAST = 1e-6


def end_of_line(values: np.ndarray) -> np.ndarray:
    """Return the end (...) of a line fitted to rows (N, ...), which does not lag as a mean."""
    count = len(values)
    if count < 3:
        return values[-1]
    offset = np.arange(count) - (count - 1) / 2
    weights = 1 / count + offset * (offset[-1] / (offset @ offset))
    return np.tensordot(weights, values, axes=1)


class PressFrames:
    """Frames of one press, filled as they are reached; results are in SI units.

    `residual` and `slip_excess` stay NaN: no equations are solved, and Coulomb's law holds at each
    node. `balance` is the rate of momentum over the force, and NaN if fixed particles take the
    reaction.
    """

    def __init__(self, scene: Scene, pace: Pace, state: ParticleState, env: int) -> None:
        self._scene, self._pace, self._lattice = scene, pace, state.lattice
        self._units: Units = state.units[env]
        frames = len(scene.motion)
        nx, ny, _nz = state.lattice.counts
        self._wrench = np.full((frames, 6), np.nan)
        self._surface = np.full((frames, nx, ny, 3), np.nan, np.float32)
        self._quality = no_quality(frames)
        self._readings = np.zeros((pace.steps, 9))
        self._velocity = _tip_velocity(pace, state.lattice.cell)
        self._kinetic_share = 0.0
        self._start: float | None = None
        self._work_most = 0.0

    @property
    def at(self) -> np.ndarray:
        """Numbers of steps after which a frame is kept (F,)."""
        return self._pace.at[1:]

    def read(self, first: int, readings: np.ndarray) -> None:
        """Store the impulses of steps `first` onwards (N, 9); those past the end are dropped."""
        room = self._readings[first : first + len(readings)]
        room[:] = readings[: len(room)]

    def keep(self, frame: int, surface: np.ndarray, means: Means) -> None:
        """Store the state of this environment after step `at[frame]` as that frame."""
        units, pace, quality = self._units, self._pace, self._quality
        end, before = int(pace.at[frame + 1]), int(pace.at[frame])
        quality["steps"][frame] = end - (before if frame else 0)
        push, base = np.zeros(6), np.zeros(3)
        if end > 0:
            first = max(end - max(pace.window, 1), min(before, end - 1))
            fitted = end_of_line(self._readings[first:end])
            push, base = fitted[:6], fitted[6:]
        self._wrench[frame, :3] = push[:3] * units.force
        self._wrench[frame, 3:] = push[3:] * units.force * units.length
        self._surface[frame] = surface * units.length
        size = float(np.linalg.norm(push[:3]))
        if not self._lattice.held and size > 0:
            total = push[:3] + base
            quality["balance"][frame] = float(np.linalg.norm(total)) / size
        quality["contact"][frame] = self._penetration(frame)
        quality["det_f_min"][frame] = means.det_min
        self._count_energy(frame, end, means)

    def _count_energy(self, frame: int, end: int, means: Means) -> None:
        volume = self._lattice.volume.sum()
        energy = (means.stored + means.kinetic) * volume
        forces = self._readings[:end, :3]
        spent = np.concatenate([[0.0], np.cumsum((forces * self._velocity[:end]).sum(axis=1))])
        if self._start is None:
            self._start = energy - spent[-1]
        most = max(self._work_most, float(spent.max()))
        self._work_most = most
        lost = spent[-1] - (energy - self._start)
        self._quality["energy_gap"][frame] = lost / most if most > 0 else 0.0
        if means.stored > 0:
            self._kinetic_share = max(self._kinetic_share, means.kinetic / means.stored)

    def _penetration(self, frame: int) -> float:
        """Return the largest depth of the top inside the indenter, over the depth of the press."""
        lattice, body = self._lattice, self._scene.body
        undeformed = np.zeros((*lattice.counts[:2], 3))
        undeformed[..., 0], undeformed[..., 1] = lattice.surface_x[:, None], lattice.surface_y
        undeformed[..., 2] = body.heights(lattice.surface_x, lattice.surface_y)
        tip = np.asarray(self._scene.motion.tip[frame])
        gap, _ = self._scene.indenter.distance(undeformed + self._surface[frame] - tip)
        return max(0.0, -float(gap.min())) / max(-float(tip[2]), DEPTH_LEAST)

    @property
    def lost(self) -> float:
        """Largest fraction of the work that was neither stored nor kinetic."""
        return float(np.nanmax(self._quality["energy_gap"]))

    def result(self, record: dict) -> Result:
        """Return the result; every frame must have been kept. The traction map is NaN."""
        return Result(
            scene=self._scene,
            tier="mpm",
            wrench=self._wrench,
            surface_x=self._lattice.surface_x,
            surface_y=self._lattice.surface_y,
            surface=self._surface,
            traction=np.full_like(self._surface, np.nan),
            quality=Quality(**self._quality),
            record={**record, "kinetic_over_stored": self._kinetic_share},
        )


def _tip_velocity(pace: Pace, cell: float) -> np.ndarray:
    """Return the displacement of the tip in each step (N, 3) [cells]."""
    velocity = np.zeros((pace.steps, 3))
    for k in range(1, len(pace.at)):
        first, last = pace.at[k - 1 : k + 1]
        if last > first:
            velocity[first:last] = (pace.corners[k] - pace.corners[k - 1]) / (last - first) / cell
    return velocity


# A record's values of the pace.
PACE = "mass_scaling", "wave_speed", "tip_speed", "speed_ratio", "time_step", "courant", "steps"
# Particles per cell and dimension below which the material falls apart into loose columns.
COUPLED = 1.0
# Fraction of the work of a frictionless press above which its loss is a warning: spheres lose 0.05.
LOST = 0.1


# Least height of a dome at its corners, over the thickness: lower, particles would be compressed.
RIM_LEAST = 0.5


def simulate_mpm(
    scenes: Sequence[Scene],
    numerics: Mpm = Mpm(),
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[Outcome]:
    """Simulate presses on bodies of one shape; return a result or the reason for none, in order.

    Scenes have the same size, thickness, dome and set of effects; the rest may differ.
    """
    scenes = list(scenes)
    if not scenes:
        return []
    _check(scenes)
    check_device(device)
    began = time.perf_counter()
    lattice = build_lattice(scenes, numerics)
    paces = [pace_of(scene, numerics, lattice.cell) for scene in scenes]
    state = ParticleState(lattice, scenes, paces, numerics, device)
    wp.synchronize_device(state.device)
    seconds = {"build": time.perf_counter() - began}
    frames = [
        PressFrames(scene, pace, state, env)
        for env, (scene, pace) in enumerate(zip(scenes, paces, strict=True))
    ]
    began = time.perf_counter()
    failed = _walk(state, frames, paces, scenes, progress)
    seconds["solve"] = time.perf_counter() - began
    shared = {
        "tier": "mpm",
        "cell": lattice.cell,
        "nodes": list(lattice.nodes),
        "particles": len(lattice.rest),
        "particles_per_cell": numerics.per_cell**3,
        "precision": numerics.precision,
        "device": str(state.device),
        "environments": len(scenes),
        "effects": list(scenes[0].effects.key),
        "bytes": state.bytes,
        "seconds": {name: round(value, 4) for name, value in seconds.items()},
    }
    return [
        failed.get(env)
        or frames[env].result(
            {
                **shared,
                **{name: getattr(pace, name) for name in PACE},
                "window_steps": pace.window,
                "warnings": _warnings(scene, pace, numerics, frames[env].lost),
            }
        )
        for env, (scene, pace) in enumerate(zip(scenes, paces, strict=True))
    ]


def _walk(state, frames, paces, scenes, progress) -> dict[int, SimulationDiverged]:
    """Take all steps, stopping where a frame is due; return the failures by environment."""
    total = max(pace.steps for pace in paces)
    failed: dict[int, SimulationDiverged] = {}
    now = 0
    due = sorted({int(step) for one in frames for step in one.at})
    for stop in due:
        while now < stop and len(failed) < len(frames):
            steps = min(ROUND, stop - now)
            readings = state.advance(steps)
            for env, one in enumerate(frames):
                one.read(now, readings[:, env])
            now += steps
            for env in np.flatnonzero(state.batch.status.numpy()):
                if env not in failed:
                    failed[int(env)] = _diverged(state, int(env), paces[env], scenes[env])
            if progress is not None:
                progress(now / total)
        reached = [
            (env, frame)
            for env, one in enumerate(frames)
            for frame in np.flatnonzero(one.at == stop)
            if env not in failed
        ]
        if not reached:
            continue
        surface, means = state.surface(), state.means()
        for env, frame in reached:
            frames[env].keep(int(frame), surface[env], means[env])
    return failed


REASONS = {
    LEFT_GRID: "a particle left the grid",
    COLLAPSED: "a particle was squeezed to nothing",
    TOO_FAST: f"a particle moved {SPEED_LIMIT:g} cells in one step",
}


def _diverged(state, env: int, pace: Pace, scene: Scene) -> SimulationDiverged:
    step = int(state.batch.step.numpy()[env])
    tip = state.batch.tip.numpy()[env] * state.lattice.cell * 1e3
    reason = REASONS[int(state.batch.status.numpy()[env])]
    return SimulationDiverged(
        f"{reason} in step {step} of {pace.steps}, with the tip at ({tip[0]:.4g}, {tip[1]:.4g}, "
        f"{tip[2]:.4g}) mm; Courant number {pace.courant:.3g}, tip at {pace.speed_ratio:.3g} of "
        f"the wave speed, body {scene.body.thickness * 1e3:.3g} mm thick",
        tried=(f"step {step}: {reason}",),
    )


def _warnings(scene: Scene, pace: Pace, numerics: Mpm, lost: float) -> list[str]:
    """Return warnings about differences between this result and a solution of the scene."""
    warnings = []
    if numerics.per_cell < COUPLED:
        warnings.append(
            f"{numerics.per_cell:.3g} particles per cell and dimension: below {COUPLED:g} the "
            "material comes apart into loose columns; allowed without this warning: 1, better 2"
        )
    if pace.speed_ratio > QUASI_STATIC:
        warnings.append(
            f"the tip moves at {pace.speed_ratio:.3g} of the wave speed of {pace.wave_speed:.3g} "
            f"m/s: not quasi-static; allowed without this warning: up to {QUASI_STATIC:g}"
        )
    if scene.effects.friction is None and lost > LOST:
        warnings.append(
            f"{100 * lost:.0f} % of the work is lost: between two layers of nodes the surface "
            "slips past the indenter, and a flat face loads it in steps; allowed without this "
            f"warning: up to {100 * LOST:.0f} %, with smaller cells or a rounder indenter"
        )
    if numerics.published is not None and scene.effects.friction is not None:
        warnings.append("sticky contact: the scene's friction coefficient is not used")
    if numerics.published is not None:
        warnings.append("a particle's volume was given: forces are scaled with it")
    return warnings


def _check(scenes: Sequence[Scene]) -> None:
    """Reject scenes that the tier does not support, or that are no batch."""
    first = scenes[0]
    for index, scene in enumerate(scenes):
        body, key = scene.body, f"scenes[{index}].body"
        for name in ("size_x", "size_y", "thickness", "dome_radius"):
            if getattr(body, name) != getattr(first.body, name):
                raise SceneError(
                    f"{key}.{name}: {getattr(body, name)!r}; allowed: "
                    f"{getattr(first.body, name)!r}, as in the batch's first scene"
                )
        if body.footprint != "rectangle":
            raise SceneError(
                f"{key}.footprint: {body.footprint!r}; allowed with tier 'mpm': 'rectangle'"
            )
        if body.rim < RIM_LEAST * body.thickness:
            raise SceneError(
                f"{key}.dome_radius: {body.dome_radius!r} m, which leaves {body.rim * 1e3:.3g} "
                f"mm at the corners; allowed with tier 'mpm': {100 * RIM_LEAST:g} % of the "
                "thickness or more"
            )
        for name in ("viscosity", "inertia", "gravity"):
            effect = getattr(scene.effects, name)
            if effect is not None:
                raise SceneError(
                    f"scenes[{index}].effects.{name}: {effect!r}; allowed with tier 'mpm': None"
                )
        if scene.effects.key != first.effects.key:
            raise SceneError(
                f"scenes[{index}].effects: {scene.effects.key}; allowed: {first.effects.key}, as "
                "in the batch's first scene"
            )
