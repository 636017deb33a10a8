# mypy: ignore-errors
# Drives Warp arrays, typed at run time; mypy cannot follow them.
"""The `mpm` tier: presses walked through in time, all of them side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from sim.errors import SceneError, SimulationDiverged
from sim.mpm.frames import Frames
from sim.mpm.lattice import build_lattice, same_body
from sim.mpm.numerics import MpmNumerics
from sim.mpm.pace import QUASI_STATIC, Pace, pace_of
from sim.mpm.particles import COLLAPSED, LEFT_GRID, SPEED_LIMIT, TOO_FAST
from sim.mpm.state import ROUND, State
from sim.result import Outcome
from sim.scene import Scene

Progress = Callable[[float], None]

COUPLED = 1.0
"""Particles per cell and dimension below which the material falls apart into loose columns."""
LOST = 0.1
"""Share of the work above which what a frictionless press loses is told of: spheres lose 0.05."""


def simulate_mpm(
    scenes: Sequence[Scene],
    numerics: MpmNumerics | None = None,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[Outcome]:
    """Simulate presses on bodies of one shape; a result or the reason for none, in their order.

    Args:
        scenes: Same size, thickness and dome, same set of effects; everything else may differ.
        numerics: Grid, sampling, mass, time step and contact.
        device: `cpu`, or `cuda:0` and the like.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: Viscosity; scenes that cannot share a lattice; a lattice or a time step that
            cannot be.
    """
    numerics = numerics or MpmNumerics()
    scenes = list(scenes)
    if not scenes:
        return []
    same_body(scenes)
    _same_effects(scenes)
    _check_device(device)
    began = time.perf_counter()
    lattice = build_lattice(scenes, numerics)
    paces = [pace_of(scene, numerics, lattice.cell) for scene in scenes]
    state = State(lattice, scenes, paces, numerics, device)
    wp.synchronize_device(state.device)
    seconds = {"build": time.perf_counter() - began}
    frames = [
        Frames(scene, pace, state, env)
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
                **_of_pace(pace),
                "warnings": _warnings(scene, pace, numerics, frames[env].lost),
            }
        )
        for env, (scene, pace) in enumerate(zip(scenes, paces, strict=True))
    ]


def _walk(state, frames, paces, scenes, progress) -> dict[int, SimulationDiverged]:
    """Take all steps, stopping wherever a frame is due; what failed, by environment."""
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
            for env in np.flatnonzero(state.status.numpy()):
                if env not in failed:
                    failed[int(env)] = _diverged(state, int(env), paces[env], scenes[env])
            if progress is not None:
                progress(now / total)
        wanted = [
            (env, frame)
            for env, one in enumerate(frames)
            for frame in np.flatnonzero(one.at == stop)
            if env not in failed
        ]
        if not wanted:
            continue
        surface, means = state.surface(), state.means()
        for env, frame in wanted:
            frames[env].keep(int(frame), surface[env], means[env])
    return failed


REASONS = {
    LEFT_GRID: "a particle left the grid",
    COLLAPSED: "a particle was squeezed to nothing (numerics.det_floor)",
    TOO_FAST: f"a particle went {SPEED_LIMIT:g} cells in one step",
}


def _diverged(state, env: int, pace: Pace, scene: Scene) -> SimulationDiverged:
    step = int(state.step.numpy()[env])
    tip = state.tip.numpy()[env] * state.lattice.cell * 1e3
    reason = REASONS[int(state.status.numpy()[env])]
    return SimulationDiverged(
        f"{reason} in step {step} of {pace.steps}, with the tip at ({tip[0]:.4g}, {tip[1]:.4g}, "
        f"{tip[2]:.4g}) mm; Courant number {pace.courant:.3g}, tip at {pace.speed_ratio:.3g} of "
        f"the wave speed, body {scene.body.thickness * 1e3:.3g} mm thick",
        tried=(f"step {step}: {reason}",),
    )


def _of_pace(pace: Pace) -> dict:
    return {
        "mass_scaling": pace.mass_scaling,
        "wave_speed": pace.wave_speed,
        "tip_speed": pace.tip_speed,
        "speed_ratio": pace.speed_ratio,
        "time_step": pace.time_step,
        "courant": pace.courant,
        "steps": pace.steps,
        "window_steps": pace.window,
    }


def _warnings(scene: Scene, pace: Pace, numerics: MpmNumerics, lost: float) -> list[str]:
    """What makes this result less than a solution of the scene."""
    found = []
    if numerics.per_cell < COUPLED:
        found.append(
            f"{numerics.per_cell:.3g} particles per cell and dimension: below {COUPLED:g} the "
            "material comes apart into loose columns; allowed without this warning: 1, better 2"
        )
    if scene.effects.inertia is None and pace.speed_ratio > QUASI_STATIC:
        found.append(
            f"the tip goes at {pace.speed_ratio:.3g} of the wave speed of {pace.wave_speed:.3g} "
            f"m/s: not quasi-static; allowed without this warning: up to {QUASI_STATIC:g}"
        )
    if scene.effects.friction is None and lost > LOST:
        found.append(
            f"{100 * lost:.0f} % of the work is lost: between two layers of nodes the surface "
            "slips past the indenter, and a flat face loads it in steps; allowed without this "
            f"warning: up to {100 * LOST:.0f} %, with smaller cells or a rounder indenter"
        )
    if numerics.contact == "sticky" and scene.effects.friction is not None:
        found.append("sticky contact: the scene's friction coefficient is not used")
    if numerics.particle_volume is not None:
        found.append("a particle's volume was given: forces are scaled with it")
    return found


def _same_effects(scenes: Sequence[Scene]) -> None:
    first = scenes[0].effects
    for index, scene in enumerate(scenes):
        if scene.effects.viscosity is not None:
            raise SceneError(
                f"scenes[{index}].effects.viscosity: {scene.effects.viscosity!r}; allowed: None, "
                "tier 'mpm' has no relaxing material"
            )
        if scene.effects.key != first.key:
            raise SceneError(
                f"scenes[{index}].effects: {scene.effects.key}; allowed: {first.key}, as in the "
                "batch's first scene"
            )


def _check_device(device: str) -> None:
    try:
        wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        allowed = ", ".join(str(each) for each in wp.get_devices())
        raise SceneError(f"device: {device!r}; allowed here: {allowed}") from error
