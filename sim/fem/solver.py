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
from sim.fem.mesh import Mesh
from sim.fem.newton import Newton
from sim.fem.numerics import Numerics
from sim.fem.path import Path, path_of, sharpest
from sim.fem.readings import Snapshot
from sim.fem.window import meshes_of
from sim.indenters.device import traits_of
from sim.result import Outcome
from sim.scene import Scene

Progress = Callable[[float], None]

POISSON_FLOAT32 = 0.4995
"""Above this, `auto` does not try float32: the pressure is 3,000 times the shear stress there."""
ELEMENTS_SIDE_BY_SIDE = {"cpu": 20_000, "cuda": 20_000_000}
"""Elements of a batch at most: what stays in a CPU's cache; what fits a GPU's memory."""


def simulate_fem(
    scenes: Sequence[Scene],
    numerics: Numerics | None = None,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[Outcome]:
    """Simulate presses; a result or the reason for none, in their order.

    Args:
        scenes: What is simulated; those with the same thickness, mesh topology and set of effects
            are solved side by side.
        numerics: Mesh, precision and tolerances.
        device: `cpu`, or `cuda:0` and the like.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: A mesh that cannot be built, or a device that is not there.
    """
    numerics = numerics or Numerics()
    _check_device(device)
    began = time.perf_counter()
    meshes = meshes_of(scenes, numerics)
    meshed = (time.perf_counter() - began) / max(len(scenes), 1)
    outcomes: dict[int, Outcome] = {}
    for chosen in _batches(scenes, meshes, device):
        share = None
        if progress is not None:
            share = _part(progress, len(outcomes), len(chosen), len(scenes))
        some = _solve(
            [scenes[i] for i in chosen],
            [meshes[i] for i in chosen],
            numerics,
            device,
            meshed * len(chosen),
            share,
        )
        outcomes.update(zip(chosen, some, strict=True))
    return [outcomes[i] for i in range(len(scenes))]


def _batches(scenes: Sequence[Scene], meshes: Sequence[Mesh], device: str) -> list[list[int]]:
    """Which scenes are solved side by side: same mesh topology, same kernels, not too many."""
    alike: dict[tuple, list[int]] = {}
    for index, (scene, mesh) in enumerate(zip(scenes, meshes, strict=True)):
        kernels = scene.effects.key, traits_of([scene.indenter])
        alike.setdefault((scene.body.thickness, mesh.cells, kernels), []).append(index)
    most = ELEMENTS_SIDE_BY_SIDE["cuda" if wp.get_device(device).is_cuda else "cpu"]
    batches = []
    for group in alike.values():
        size = max(1, most // len(meshes[group[0]].elements))
        batches += [group[i : i + size] for i in range(0, len(group), size)]
    return batches


def _part(progress: Progress, before: int, these: int, all_: int) -> Progress:
    """What tells of the share of a batch as a share of the whole."""
    return lambda share: progress((before + share * these) / all_)


def _solve(scenes, meshes, numerics, device, meshed, progress) -> list[Outcome]:
    """One batch, in the precision asked for or the one it takes."""
    first, reason = _first_precision(scenes, numerics)
    outcomes = _Batch(scenes, meshes, numerics, first, device, meshed, progress).run()
    if numerics.precision != "auto":
        return outcomes
    if first == "float64":
        return [_with_reason(outcome, reason) for outcome in outcomes]
    again = [i for i, outcome in enumerate(outcomes) if isinstance(outcome, SimulationDiverged)]
    if again:
        retried = _Batch(
            [scenes[i] for i in again],
            [meshes[i] for i in again],
            numerics,
            "float64",
            device,
            meshed,
            progress,
        ).run()
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


class _Batch:
    """Presses on meshes of one topology, each at its own step of its own path."""

    def __init__(self, scenes, meshes, numerics, precision, device, meshed, progress) -> None:
        self._scenes, self._meshes, self._numerics = scenes, meshes, numerics
        self._progress = progress
        began = time.perf_counter()
        self._assembly = Assembly(meshes, scenes, numerics, precision, device)
        self._newton = Newton(self._assembly)
        self._collectors = [
            Collector(scene, mesh, self._assembly)
            for scene, mesh in zip(scenes, meshes, strict=True)
        ]
        self._paths: list[Path] = [path_of(scene, numerics) for scene in scenes]
        self._seconds = {"mesh": meshed, "build": time.perf_counter() - began}
        self._failed: dict[int, SimulationDiverged] = {}
        count = len(scenes)
        self._busy = np.zeros(count, bool)
        self._augmented = np.zeros(count, int)
        self._last = np.zeros((count, 2))
        self._tip, self._share = np.zeros((count, 3)), np.zeros(count)
        self._duration = np.ones(count)
        self._assembly.state.start(np.array([path.corners[0] for path in self._paths]))

    def run(self) -> list[Outcome]:
        began = time.perf_counter()
        newton = self._newton
        while True:
            open_ = np.array(
                [not path.finished and i not in self._failed for i, path in enumerate(self._paths)]
            )
            if not open_.any():
                break
            self._begin(open_ & ~self._busy)
            running = self._busy & ~newton.converged & ~newton.failed
            if running.any():
                newton.sweep(running)
            self._finish(self._busy & (newton.converged | newton.failed))
        self._seconds["solve"] = time.perf_counter() - began
        record = self._record()
        return [
            self._failed.get(i) or collector.result({**record, "warnings": self._warnings(i)})
            for i, collector in enumerate(self._collectors)
        ]

    def _begin(self, idle: np.ndarray) -> None:
        """Begin the next step of those that are idle (B,)."""
        if not idle.any():
            return
        guess, tolerance = np.zeros(len(idle)), np.zeros(len(idle))
        for i in np.flatnonzero(idle).tolist():
            path = self._paths[i]
            self._share[i], self._tip[i], self._duration[i] = path.goal()
            tolerance[i] = self._tolerance(self._share[i])
            segment, step = self._last[i]
            going_on = segment == path.segment and step > 0 and path.halvings == 0
            if going_on and "friction" in self._assembly.effects:
                guess[i] = min((self._share[i] - path.share) / step, 1.5)
        self._busy |= idle
        self._augmented[idle] = 0
        self._assembly.state.begin_step(idle, self._tip, self._duration, guess)
        self._newton.begin(idle, tolerance, predict=guess == 0)

    def _tolerance(self, share: float) -> float:
        numerics = self._numerics
        loose = numerics.path_tolerance
        if loose is None:
            history = {"viscosity", "inertia"} & set(self._assembly.effects)
            loose = 1e-3 if history else 1e-2
        return numerics.tolerance if share >= 1.0 else max(loose, numerics.tolerance)

    def _finish(self, done: np.ndarray) -> None:
        """Take the steps that have converged, halve those that have failed (B,)."""
        if not done.any():
            return
        assembly, newton = self._assembly, self._newton
        again, good, bad = np.zeros((3, len(done)), bool)
        for i in np.flatnonzero(done).tolist():
            spent = self._collectors[i].spent
            spent.newton += int(newton.iterations[i])
            spent.cg += int(newton.cg[i])
            if not newton.converged[i]:
                bad[i] = True
            elif self._share[i] >= 1.0 and self._augmented[i] < self._augmentations(i):
                again[i] = True
            else:
                good[i] = True
        if again.any():
            self._augmented[again] += 1
            assembly.state.carry(newton.mask(again))
            newton.resume(again)
        self._take(good)
        if bad.any():
            assembly.state.give_up(newton.mask(bad))
        for i in np.flatnonzero(bad).tolist():
            self._collectors[i].spent.steps += 1
            said = f"{newton.iterations[i]} Newton iterations, residual {newton.residual[i]:.2e}"
            self._last[i] = -1
            if not self._paths[i].refuse(self._share[i], said):
                self._failed[i] = self._diverged(i)
        self._busy &= ~(good | bad)

    def _augmentations(self, env: int) -> int:
        touched = self._assembly.sums.contact[env].any()
        return self._numerics.augmentations if touched else 0

    def _take(self, good: np.ndarray) -> None:
        if not good.any():
            return
        assembly = self._assembly
        kept: dict[int, int] = {}
        for i in np.flatnonzero(good).tolist():
            path, collector = self._paths[i], self._collectors[i]
            collector.spent.steps += 1
            collector.moved(self._tip[i], assembly.sums.contact[i])
            self._last[i] = path.segment, self._share[i] - path.share
            frame = path.segment
            if path.accept(self._share[i]):
                kept[i] = frame
        held = Snapshot(assembly, list(kept))
        for i, frame in kept.items():
            self._collectors[i].keep(frame, i, held, self._newton.residual[i])
        assembly.accept(good, self._duration)
        if self._progress is not None:
            done = sum(path.segment + path.share - 1 for path in self._paths)
            whole = sum(max(len(path.corners) - 2, 1) for path in self._paths)
            self._progress(max(done, 0.0) / whole)

    def _diverged(self, env: int) -> SimulationDiverged:
        path, scene = self._paths[env], self._scenes[env]
        state = self._assembly.state
        dump = File(tempfile.mkdtemp(prefix="diverged-")) / "state.npz"
        try:
            np.savez_compressed(
                dump,
                scene=json.dumps(repr(scene)),
                tip=state.tip_before[env] * scene.body.thickness,
                u=state.u_old.numpy()[env] * scene.body.thickness,
                nodes=self._meshes[env].nodes * scene.body.thickness,
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
        element = self._meshes[env].finest * scene.body.thickness
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
                "cells": list(assembly.mesh.cells),
                "elements": len(assembly.mesh.elements),
                "nodes": len(assembly.mesh.nodes),
            },
            "precision": assembly.precision,
            "device": str(assembly.device),
            "environments": assembly.environments,
            "effects": list(assembly.effects),
            "seconds": {name: round(value, 4) for name, value in self._seconds.items()},
        }
