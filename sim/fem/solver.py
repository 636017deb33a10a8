# mypy: ignore-errors
# Drives Warp arrays, typed at run time; mypy cannot follow them.
"""The `fem` tier: every press walks its own path, all of them solved side by side."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path as File

import numpy as np
import warp as wp

from sim.errors import SceneError, SimulationDiverged
from sim.fem.assembly import Assembly
from sim.fem.frames import Collector
from sim.fem.mesh import build_mesh
from sim.fem.newton import Newton
from sim.fem.numerics import Numerics
from sim.fem.path import Path, path_of, sharpest
from sim.result import Result
from sim.scene import Scene

Progress = Callable[[float], None]
Outcome = Result | SimulationDiverged

POISSON_FLOAT32 = 0.4995
"""Above this, `auto` does not try float32: the pressure is 3,000 times the shear stress there."""
SPACING_SHARE = 6
"""Elements through the thickness when no spacing is given."""


def simulate_fem(
    scenes: Sequence[Scene],
    numerics: Numerics | None = None,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[Outcome]:
    """Simulate presses on bodies of one shape; a result or the reason for none, in their order.

    Args:
        scenes: Same size, thickness and dome, same set of effects; everything else may differ.
        numerics: Mesh, precision and tolerances.
        device: `cpu`, or `cuda:0` and the like.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: Scenes that cannot share a mesh, or a mesh that cannot be built.
    """
    numerics = numerics or Numerics()
    _same_batch(scenes)
    body = scenes[0].body
    spacing = numerics.spacing
    if spacing is None:
        spacing = body.thickness / SPACING_SHARE
    _check_device(device)
    began = time.perf_counter()
    mesh = build_mesh(body, spacing)
    meshed = time.perf_counter() - began
    first, reason = _first_precision(scenes, numerics)
    outcomes = _Batch(scenes, mesh, numerics, first, device, meshed, progress).run()
    if numerics.precision != "auto":
        return outcomes
    if first == "float64":
        return [_with_reason(outcome, reason) for outcome in outcomes]
    again = [i for i, outcome in enumerate(outcomes) if isinstance(outcome, SimulationDiverged)]
    if again:
        batch = [scenes[i] for i in again]
        retried = _Batch(batch, mesh, numerics, "float64", device, meshed, progress).run()
        for i, outcome in zip(again, retried, strict=True):
            _forget_dump(outcomes[i].dump)
            outcomes[i] = _with_reason(outcome, f"float32 did not converge: {outcomes[i]}")
    return outcomes


def _first_precision(scenes: Sequence[Scene], numerics: Numerics) -> tuple[str, str]:
    """The precision to begin with, and why."""
    if numerics.precision != "auto":
        return numerics.precision, "asked for"
    poisson = max(scene.body.poisson for scene in scenes)
    if poisson > POISSON_FLOAT32:
        return "float64", (
            f"Poisson's ratio {poisson:g} is above {POISSON_FLOAT32:g}, where float32 seldom "
            "reaches the tolerance"
        )
    return "float32", ""


def _with_reason(outcome: Outcome, reason: str) -> Outcome:
    if isinstance(outcome, SimulationDiverged):
        return outcome
    return replace(outcome, record={**outcome.record, "precision_reason": reason})


def _forget_dump(dump: File | None) -> None:
    """Remove what a failed attempt left, now that another one followed it."""
    if dump is not None:
        dump.unlink(missing_ok=True)
        dump.parent.rmdir()


def _check_device(device: str) -> None:
    try:
        wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        allowed = ", ".join(str(each) for each in wp.get_devices())
        raise SceneError(f"device: {device!r}; allowed here: {allowed}") from error


def _same_batch(scenes: Sequence[Scene]) -> None:
    first = scenes[0]
    for index, scene in enumerate(scenes):
        for name in ("size_x", "size_y", "thickness", "dome_radius"):
            if getattr(scene.body, name) != getattr(first.body, name):
                raise SceneError(
                    f"scenes[{index}].body.{name}: {getattr(scene.body, name)!r}; allowed: "
                    f"{getattr(first.body, name)!r}, as in the batch's first scene"
                )
        if scene.effects.key != first.effects.key:
            raise SceneError(
                f"scenes[{index}].effects: {scene.effects.key}; allowed: {first.effects.key}, as "
                "in the batch's first scene"
            )


class _Batch:
    def __init__(self, scenes, mesh, numerics, precision, device, meshed, progress) -> None:
        self._scenes, self._mesh, self._numerics = scenes, mesh, numerics
        self._progress = progress
        began = time.perf_counter()
        self._assembly = Assembly(mesh, scenes, numerics, precision, device)
        self._newton = Newton(self._assembly)
        self._collectors = [Collector(scene, self._assembly) for scene in scenes]
        self._paths: list[Path] = [path_of(scene, numerics) for scene in scenes]
        self._seconds = {"mesh": meshed, "build": time.perf_counter() - began}
        self._failed: dict[int, SimulationDiverged] = {}
        self._last = np.zeros((len(scenes), 2))
        start = np.array([path.corners[0] for path in self._paths])
        state = self._assembly.state
        state.tip_old.assign(state._array(start, state.tip_old.dtype))

    def run(self) -> list[Outcome]:
        began = time.perf_counter()
        while True:
            open_ = np.array(
                [not path.finished and i not in self._failed for i, path in enumerate(self._paths)]
            )
            if not open_.any():
                break
            self._step(open_)
            if self._progress is not None:
                done = sum(path.segment + path.share - 1 for path in self._paths)
                whole = sum(max(len(path.corners) - 2, 1) for path in self._paths)
                self._progress(max(done, 0.0) / whole)
        self._seconds["solve"] = time.perf_counter() - began
        record = self._record()
        return [
            self._failed.get(i) or collector.result({**record, "warnings": self._warnings(i)})
            for i, collector in enumerate(self._collectors)
        ]

    def _step(self, open_: np.ndarray) -> None:
        assembly, state = self._assembly, self._assembly.state
        tip = state.tip.numpy().astype(float)
        share, duration = np.zeros(len(tip)), np.ones(len(tip))
        guess = np.zeros(len(tip))
        for i in np.flatnonzero(open_):
            path = self._paths[i]
            share[i], tip[i], duration[i] = path.goal()
            segment, step = self._last[i]
            if segment == path.segment and step > 0 and path.halvings == 0:
                guess[i] = min((share[i] - path.share) / step, 1.5)
        state.begin_step(tip, duration, guess)
        outcome = self._newton.solve(open_)
        good = open_ & outcome.converged
        mask = wp.array(good.astype(np.int32), dtype=wp.int32, device=assembly.device)
        assembly.accept(mask, duration)
        force = assembly.contact_force() if good.any() else None
        reached = []
        for i in np.flatnonzero(open_):
            path, collector = self._paths[i], self._collectors[i]
            spent = collector.spent
            spent.newton += int(outcome.iterations[i])
            spent.cg += int(outcome.cg[i])
            spent.steps += 1
            if good[i]:
                collector.moved(tip[i], force[i])
                self._last[i] = path.segment, share[i] - path.share
                if path.accept(share[i]):
                    reached.append(i)
                continue
            said = f"{outcome.iterations[i]} Newton iterations, residual {outcome.residual[i]:.2e}"
            self._last[i] = -1
            if not path.refuse(share[i], said):
                self._failed[i] = self._diverged(i)
        if reached:
            reaction = assembly.reactions()
            for i in reached:
                frame = self._paths[i].segment - 1
                self._collectors[i].keep(frame, i, assembly, outcome.residual[i], reaction[i])

    def _diverged(self, env: int) -> SimulationDiverged:
        path, scene = self._paths[env], self._scenes[env]
        state = self._assembly.state
        dump = File(tempfile.mkdtemp(prefix="diverged-")) / "state.npz"
        try:
            np.savez_compressed(
                dump,
                scene=json.dumps(repr(scene)),
                tip=state.tip_old.numpy()[env] * scene.body.thickness,
                u=state.u_old.numpy()[env] * scene.body.thickness,
                nodes=self._mesh.nodes * scene.body.thickness,
            )
        except OSError:
            dump = None
        where = path.corners[path.segment] + path.share * (
            path.corners[path.segment + 1] - path.corners[path.segment]
        )
        millimetres = where * scene.body.thickness * 1e3
        return SimulationDiverged(
            f"no converged state after the tip at ({millimetres[0]:.4g}, {millimetres[1]:.4g}, "
            f"{millimetres[2]:.4g}) mm, on the way to waypoint {path.segment}: "
            f"{len(path.tried)} steps failed, the last: {path.tried[-1]}; "
            f"{self._assembly.precision}; state: {dump or 'could not be written'}",
            tried=tuple(path.tried),
            dump=dump,
        )

    def _warnings(self, env: int) -> list[str]:
        """What makes this result less than its tolerances say."""
        scene = self._scenes[env]
        radius = sharpest(scene.indenter)
        nx, ny, _nz = self._mesh.cells
        element = max(scene.body.size_x / nx, scene.body.size_y / ny)
        if radius >= 0.99 * element:
            return []
        return [
            f"edge radius {radius * 1e3:.3g} mm is below the element's {element * 1e3:.3g} mm: the "
            "force depends on the mesh and on the path; allowed without this warning: a finer "
            "mesh or a rounder edge"
        ]

    def _record(self) -> dict:
        assembly = self._assembly
        return {
            "tier": "fem",
            "mesh": {
                "cells": list(self._mesh.cells),
                "elements": len(self._mesh.elements),
                "nodes": len(self._mesh.nodes),
            },
            "precision": assembly.precision,
            "device": str(assembly.device),
            "environments": assembly.environments,
            "effects": list(assembly.effects),
            "seconds": {name: round(value, 4) for name, value in self._seconds.items()},
        }
