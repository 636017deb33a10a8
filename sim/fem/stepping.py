# mypy: ignore-errors
# Drives and reads Warp arrays, typed at run time; mypy cannot follow them.
"""Steps of a batch: presses advance together, each along its own path."""

from __future__ import annotations

import json
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any

import numpy as np

from sim.errors import SimulationDiverged
from sim.fem.assembly import Assembly
from sim.fem.contact import OVERLAPS
from sim.fem.frames import Collector, Spent
from sim.fem.newton import (
    DET_FLOOR,
    NEARLY_CRUSHED,
    PATIENCE,
    ROUNDING,
    Newton,
    Path,
    path_of,
)
from sim.fem.sizing import Sizes, finer_at
from sim.fem.verdict import (
    FOLD,
    LEAP,
    OVERLAP_MOST,
    PASSED,
    Kind,
    advice,
    overlap_place,
    shares,
)
from sim.result import SIDES, Outcome, width_of

# Samples along a side of a face at which overlap is measured, for frames and for intermediate
# states; and the number of states per step, its end included.
FRAME_SAMPLES, PATH_SAMPLES, PATH_STATES = 8, 3, 3
# Further updates of the multipliers where an indenter has all but left the skin: they remember the
# press before, and each leaves a tenth of it or less. Below this fraction of the largest force.
FADED, FADED_BELOW = 3, 0.01
# Threads of the host that look at folded skins beside a GPU. Nearly half of their work holds the
# interpreter's lock, so that more threads wait for each other: two were 1.9 times as fast as one,
# six 1.5 times (two cores), and sixteen on sixteen cores slower than six.
THREADS = 3


class Crossed(SimulationDiverged):
    """No result, because the skin passes through itself or through the indenter.

    It has what `Result` has of the mesh, and `wanted`, the elements that may avoid it.
    """

    wanted: Sizes
    surface_x: np.ndarray
    """Positions of the nodes of the mesh (X,) [m]."""
    surface_y: np.ndarray
    """The same along y (Y,) [m]."""
    record: dict


def on_host(device: str, function: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
    """Return a function of the host for each of the items: in threads beside a GPU.

    A GPU's batch has many presses, and NumPy leaves the interpreter's lock to other threads.
    """
    if device == "cpu":
        return list(map(function, *items))
    from recorder.processes import cores

    with ThreadPoolExecutor(min(THREADS, cores())) as pool:
        return list(pool.map(function, *items))


@dataclass(frozen=True, slots=True)
class Passed:
    """A step in which something has passed through the skin."""

    why: str
    """The reason, if the path ends there."""
    wanted: Sizes
    """Elements that may avoid it."""
    brief: str
    """The same in a few words."""


@dataclass(frozen=True, slots=True)
class Reached:
    """State of some environments when their batch ends, from which another one goes on."""

    history: dict[str, np.ndarray]
    """Result of `SolverState.history`."""
    collectors: list[Collector]
    """Frames kept so far."""
    paths: list[Path]
    spent: list[Spent]
    seconds: float
    """Time of the batch."""


class Batch:
    """Presses on meshes of one topology, each with a separate path and step.

    They begin at the first step, or where those of another batch have ended (`reached`).
    """

    def __init__(
        self, scenes, meshes, numerics, precision, device, meshed, progress, reached=None
    ) -> None:
        self._scenes, self._meshes, self._numerics = scenes, meshes, numerics
        self._progress = progress
        began = time.perf_counter()
        self._assembly = Assembly(meshes, scenes, numerics, precision, device)
        self._newton = Newton(self._assembly)
        self._collectors = list(map(Collector, scenes, meshes))
        self._unmeasured: deque[Collector] = deque()
        self._area = np.array([mesh.top_area for mesh in meshes])[..., None]
        self._stress = np.array([scene.body.modulus for scene in scenes])[:, None, None, None]
        self._paths: list[Path] = [
            path_of(scene, numerics, *([mesh.finest] if numerics.follows else []))
            for scene, mesh in zip(scenes, meshes, strict=True)
        ]
        self._seconds = {"mesh": meshed, "build": time.perf_counter() - began}
        self._failed: dict[int, SimulationDiverged] = {}
        count = len(scenes)
        self._spent = [Spent() for _scene in scenes]
        self._busy = np.zeros(count, bool)
        self._augmented = np.zeros(count, int)
        self._largest = np.zeros(count)  # force at a waypoint, by environment [E T^2]
        self._last = np.zeros((count, 2))
        self._deepest = np.zeros(count)  # overlap along the last accepted step [T]
        self._tip, self._share = np.zeros((count, 3)), np.zeros(count)
        self._duration, self._load = np.ones(count), np.ones(count)
        state = self._assembly.state
        state.start(np.array([path.corners[0] for path in self._paths]))
        self._before = 0.0
        if reached is not None:
            self._collectors, self._paths = reached.collectors, reached.paths
            self._spent, self._before = reached.spent, reached.seconds
            for path in self._paths:
                path.go_on(numerics.halvings)
            state.go_on(reached.history)

    def reached(self, chosen: list[int]) -> Reached:
        """Return what the chosen environments have reached: their last accepted states."""
        return Reached(
            history=self._assembly.state.history(chosen),
            collectors=[self._collectors[i] for i in chosen],
            paths=[self._paths[i] for i in chosen],
            spent=[self._spent[i] for i in chosen],
            seconds=self._seconds["solve"],
        )

    def may_go_on(self, env: int) -> bool:
        """True if an environment has failed where float64 may succeed."""
        return env in self._failed and not self._paths[env].ended

    def run(self) -> list[Outcome]:
        """Advance all presses to their last waypoint, or until they fail; return the outcomes."""
        began = time.perf_counter()
        newton = self._newton
        while True:
            paths = enumerate(self._paths)
            open_ = np.array([not p.finished and i not in self._failed for i, p in paths])
            if not open_.any():
                break
            self._begin(open_ & ~self._busy)
            running = self._busy & ~newton.converged & ~newton.failed
            if running.any():
                newton.sweep(running, self._measure)
            self._finish(self._busy & (newton.converged | newton.failed))
        self._seconds["solve"] = self._before + time.perf_counter() - began
        record = self._record()

        def outcome(env: int) -> Outcome:
            failed = self._failed.get(env)
            return failed or self._collectors[env].result({**record, **self._of_one(env)})

        return [outcome(env) for env in range(len(self._scenes))]

    def _begin(self, idle: np.ndarray) -> None:
        """Begin the next step of the idle environments (B,)."""
        if not idle.any():
            return
        guess, tolerance, patience = np.zeros((3, len(idle)))
        for i in np.flatnonzero(idle).tolist():
            path = self._paths[i]
            self._share[i], self._tip[i], self._duration[i] = path.goal()
            self._load[i] = path.load(self._share[i])
            tolerance[i] = self._tolerance(self._share[i])
            patience[i] = path.patience(self._numerics.newton_max) if path.patient else 1.0
            segment, step = self._last[i]
            going_on = segment == path.segment and step > 0 and path.halvings == 0
            if going_on and "friction" in self._assembly.effects:
                guess[i] = min((self._share[i] - path.fraction) / step, 1.5)
        self._busy |= idle
        self._augmented[idle] = 0
        if "gravity" in self._assembly.effects:
            self._assembly.state.put_weight(self._load)
        self._assembly.state.begin_step(idle, self._tip, self._duration, guess)
        self._newton.begin(idle, tolerance, predict=guess == 0, patience=patience)

    def _tolerance(self, fraction: float) -> float:
        numerics = self._numerics
        loose = numerics.path_tolerance
        if loose is None:
            history = {"viscosity", "inertia"} & set(self._assembly.effects)
            loose = 1e-3 if history else 1e-2
        return numerics.tolerance if fraction >= 1.0 else max(loose, numerics.tolerance)

    def _finish(self, done: np.ndarray) -> None:
        """Accept the steps that have converged, halve those that have failed (B,)."""
        if not done.any():
            return
        assembly, newton = self._assembly, self._newton
        again, good, bad = np.zeros((3, len(done)), bool)
        force = np.linalg.norm(assembly.sums["contact"], axis=1)
        at_goal = done & newton.converged & (self._share >= 1.0)
        self._largest[at_goal] = np.maximum(self._largest, force)[at_goal]
        for i in np.flatnonzero(done).tolist():
            spent = self._spent[i]
            spent.newton += int(newton.iterations[i])
            spent.cg += int(newton.cg[i])
            if self._augmented[i] or self._paths[i].patient:
                self._paths[i].patient_left -= max(0, int(newton.iterations[i]) - PATIENCE)
            if not newton.converged[i]:
                bad[i] = True
            elif at_goal[i] and self._augmented[i] < self._augmentations(force[i], i):
                again[i] = True
            else:
                good[i] = True
        if again.any():
            self._augmented[again] += 1
            assembly.state.update_multiplier(assembly.state.mask(again))
            most = self._numerics.newton_max
            newton.resume(again, np.array([path.patience(most) for path in self._paths]))
        way, folds, passed = self._look(good)
        for i in passed:
            good[i], bad[i] = False, True
        self._take(good, way, folds)
        if bad.any():
            assembly.state.rollback_step(assembly.state.mask(bad))
        for i in np.flatnonzero(bad).tolist():
            self._spent[i].steps += 1
            reported = (
                f"{newton.iterations[i]} Newton iterations, residual {newton.residual[i]:.2e}"
            )
            self._last[i] = -1
            crushed, through = bool(newton.crushed[i]), passed.get(i)
            why = ""
            if through is not None:
                why, reported = through.why, f"{reported}; {through.brief}"
            more = self._paths[i].refuse(self._share[i], reported, crushed=crushed, crossed=why)
            if not more or self._is_rounding(i):
                self._failed[i] = self._diverged(i, through)
        self._busy &= ~(good | bad)

    def _look(
        self, good: np.ndarray
    ) -> tuple[np.ndarray, dict[int, tuple[float, int]], dict[int, Passed]]:
        """Measure the overlaps of completed steps (B,).

        Returns:
            Overlap along the steps (B, 4); results of `self_overlap`, by environment, of those that
            have folded; those in which something has passed through the skin.
        """
        assembly, folds, passed = self._assembly, {}, {}
        if not good.any():
            return np.zeros((len(good), OVERLAPS)), folds, passed
        way = assembly.overlap(assembly.state.mask(good), samples=PATH_SAMPLES, states=PATH_STATES)
        folded = np.flatnonzero(good & (way[:, 3] > 0)).tolist()
        leapt = self._leapt(good, way[:, 0])
        some = sorted({*folded, *leapt})
        if not some:
            return way, folds, passed
        top = assembly.read(some, self._tip)[1]
        touched = dict(zip(some, top[..., 3:].any(axis=-1), strict=True))
        if folded:
            from sim.fem.self_overlap import self_overlap

            displaced = assembly.rows(assembly.state.u, folded).astype(float)
            meshes = [self._meshes[i] for i in folded]
            found = on_host(assembly.device, self_overlap, meshes, displaced)
            folds.update(zip(folded, found, strict=True))
        overlaps = [
            (i, deep, self._meshes[i].nodes[node], FOLD)
            for i, (deep, node) in folds.items()
            if deep > PASSED * assembly.finest[i]
        ]
        overlaps += [(i, float(way[i, 0]), place, LEAP) for i, place in leapt.items()]
        for i, deep, place, kind in overlaps:
            through = self._too_deep(i, deep, place, touched[i], kind)
            if through is not None:
                passed[i] = through
        return way, folds, passed

    def _leapt(self, good: np.ndarray, way: np.ndarray) -> dict[int, np.ndarray]:
        """Return completed steps (B,) along which the skin leaps through the indenter.

        On the way it is deeper inside (`way` (B,) [T], just measured) than at both ends, by more
        than the tip has moved.

        Returns:
            By environment, the undeformed place of the skin that is deepest (3,) [T].
        """
        assembly, state = self._assembly, self._assembly.state
        allowed = np.maximum(PASSED * assembly.finest, np.linalg.norm(state.step, axis=1))
        may_be = good & (way > self._deepest + allowed)
        if not may_be.any():
            return {}
        places = {}
        for i in np.flatnonzero(may_be).tolist():
            mesh, overlap = self._meshes[i], assembly.rows(assembly.face_overlap, [i])[0, :, 0]
            places[i] = mesh.nodes[mesh.faces[np.argmax(overlap)]].mean(axis=0)
        end = assembly.overlap(state.mask(may_be), samples=PATH_SAMPLES)[:, 0]
        return {i: place for i, place in places.items() if way[i] > end[i] + allowed[i]}

    def _too_deep(
        self, env: int, deep: float, place: np.ndarray, touched: np.ndarray, kind: Kind
    ) -> Passed | None:
        """Return what to say of an overlap, or None if it is small for the contact.

        It is `deep` [T] at an undeformed place (3,) [T], where nodes of the top touch (X, Y).
        """
        mesh, unit = self._meshes[env], self._scenes[env].body.thickness
        x, y, place = mesh.x * unit, mesh.y * unit, place * unit
        width, tip = np.array([width_of(touched, x, y)]), self._tip[[env]] * unit
        (fraction,) = shares(np.array([deep * unit]), width, tip, unit)
        if fraction <= OVERLAP_MOST:
            return None
        where = kind.words.format(overlap_place(place, deep * unit, kind.inside, fraction))
        return Passed(where, finer_at(place, x, y, mesh.fineness), kind.brief)

    def _is_rounding(self, env: int) -> bool:
        """True if a step failed so close to its tolerance that float32 rounding is the limit.

        A smaller step would fail too.
        """
        if self._numerics.precision != "auto" or self._assembly.precision != "float32":
            return False
        tolerance = self._numerics.tolerance
        return bool(tolerance < self._newton.residual[env] < ROUNDING * tolerance)

    def _augmentations(self, force: float, env: int) -> int:
        if not force:
            return 0
        fades = force < FADED_BELOW * self._largest[env]
        return self._numerics.augmentations + (FADED if fades else 0)

    def _take(self, good: np.ndarray, way: np.ndarray, folds: dict[int, tuple[float, int]]) -> None:
        if not good.any():
            return
        assembly = self._assembly
        kept: dict[int, int] = {}
        work = self._newton.work(good, self._duration)
        for i in np.flatnonzero(good).tolist():
            path = self._paths[i]
            self._spent[i].steps += 1
            self._last[i] = path.segment, self._share[i] - path.fraction
            self._collectors[i].moved(float(work[i]), way[i])
            self._deepest[i] = way[i, 0]
            frame = path.segment
            floor = NEARLY_CRUSHED * DET_FLOOR
            if path.accept(self._share[i], nearly_crushed=bool(assembly.sums["det"][i] < floor)):
                kept[i] = frame
        if kept:
            self._keep(kept, folds)
        assembly.accept(good, self._duration)
        if self._progress is not None:
            done = sum(path.segment + path.fraction - 1 for path in self._paths)
            whole = sum(max(len(path.corners) - 2, 1) for path in self._paths)
            self._progress(max(done, 0.0) / whole)

    def _keep(self, kept: dict[int, int], folds: dict[int, tuple[float, int]]) -> None:
        """Keep current states as frames, given by environment."""
        assembly, some, unit = self._assembly, list(kept), self._scenes[0].body.thickness
        keeping = np.isin(np.arange(len(self._paths)), some)
        assembly.measure_overlap(assembly.state.mask(keeping), samples=FRAME_SAMPLES)
        read, top = assembly.read(some, self._tip)
        surface = top[..., :3] * unit
        traction = top[..., 3:] / self._area[some] * self._stress[some]
        sums, residual, depth = assembly.sums, self._newton.residual, -self._tip[:, 2]
        for row, (i, frame) in enumerate(kept.items()):
            deep, node = folds.get(i, (0.0, -1))
            told = (
                *(
                    depth[i],
                    residual[i],
                    sums["base"][i],
                    sums["det"][i],
                    assembly.min_force_scale[i],
                ),
                *(deep, node, self._spent[i]),
            )
            self._collectors[i].keep(frame, read[row], surface[row], traction[row], told)
            self._unmeasured.append(self._collectors[i])
            self._spent[i] = Spent()
        rounds = [i for i in kept if self._collectors[i].round is not None]
        if rounds:
            columns = assembly.rows(assembly.state.u, rounds).astype(float)
            faces = assembly.rows(assembly.state.contact.touched, rounds)
            for i, u, touched in zip(rounds, columns, faces, strict=True):
                self._collectors[i].keep_round(kept[i], u, touched, self._tip[i])

    def _measure(self, is_busy: Callable[[], bool]) -> None:
        """Measure the contacts of kept frames, press by press, while a GPU is busy.

        Those left at the end are measured for the results.
        """
        while self._unmeasured and is_busy():
            self._unmeasured.popleft().measure()

    def _diverged(self, env: int, through: Passed | None = None) -> SimulationDiverged:
        path, scene = self._paths[env], self._scenes[env]
        state = self._assembly.state
        dump = File(tempfile.mkdtemp(prefix="diverged-")) / "state.npz"
        try:
            np.savez_compressed(
                dump,
                scene=json.dumps(repr(scene)),
                tip=state.tip_before[env] * scene.body.thickness,
                u=state.contact.u_old.numpy()[env] * scene.body.thickness,
                nodes=self._meshes[env].nodes * scene.body.thickness,
            )
        except OSError:
            dump = None
        where = path.corners[path.segment] + path.fraction * (
            path.corners[path.segment + 1] - path.corners[path.segment]
        )
        weight = ""
        if path.ramped and path.segment == 0:
            pull = ", ".join(f"{value:g}" for value in scene.effects.gravity.acceleration)
            weight = (
                f" under {100 * path.fraction:.3g} % of gravity's ({pull}) m/s^2, applied "
                "in steps (the body may be too soft to carry its weight)"
            )
        millimetres = where * scene.body.thickness * 1e3
        says_more = through is not None and path.ended == through.why  # it says what is allowed
        missing = "no converged state" if through is None else "no state without overlap"
        diverged = (SimulationDiverged if through is None else Crossed)(
            f"{missing} after the tip at ({millimetres[0]:.4g}, {millimetres[1]:.4g}, "
            f"{millimetres[2]:.4g}) mm, on the way to waypoint {path.segment}{weight}: "
            f"{path.ended + '; ' if path.ended else ''}"
            f"{len(path.tried)} steps failed, the last: {path.tried[-1]}; "
            f"{'' if says_more else advice(scene)}{self._assembly.precision}; "
            f"state: {dump or 'could not be written'}",
            tried=tuple(path.tried),
            dump=dump,
        )
        if isinstance(diverged, Crossed):
            mesh, unit = self._meshes[env], scene.body.thickness
            diverged.wanted, diverged.record = through.wanted, self._record()
            diverged.surface_x, diverged.surface_y = mesh.x * unit, mesh.y * unit
        return diverged

    def _of_one(self, env: int) -> dict:
        """Return the record entries of one environment."""
        mesh, collector, body = self._meshes[env], self._collectors[env], self._scenes[env].body
        shape = self._record()["mesh"]
        shape["finest"] = mesh.finest * body.thickness
        shape["topmost"] = mesh.topmost * body.thickness
        shape["resolved"] = collector.resolved()
        if self._numerics.follows:
            shape["fineness"] = round(mesh.fineness, 4)
        return {
            "mesh": shape,
            **(entries := collector.record()),
            "warnings": self._warnings(env, entries),
        }

    def _warnings(self, env: int, entries: dict) -> list[str]:
        """Return warnings about errors of this result, with its frames' `entries` of the record."""
        scene, mesh, fineness = self._scenes[env], self._meshes[env], self._numerics.fineness
        radius = scene.indenter.sharpest
        element = mesh.finest * scene.body.thickness
        reported = []
        if self._numerics.follows and mesh.fineness < 0.99 * fineness:
            reported.append(
                f"the contact is meshed with a fineness of {mesh.fineness:.2g}, not the requested "
                f"{fineness:g}, which needs more than {self._numerics.elements_max} elements"
            )
        if radius < 0.99 * element:
            reported.append(
                f"edge radius {radius * 1e3:.3g} mm is below the element's {element * 1e3:.3g} mm: "
                "the force depends on the mesh and on the path; allowed without this warning: a "
                "finer mesh or a rounder edge"
            )
        sides = ((SIDES[name], frames) for name, frames in entries.items() if name in SIDES)
        reported += [f"{what}, at waypoints {frames}" for what, frames in sides]
        return reported

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
