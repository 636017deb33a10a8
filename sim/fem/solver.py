"""Solver of the `fem` tier: meshes, their solutions, and finer ones where those are too coarse."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from recorder.progress import span_of
from sim.arrays import Array, Progress
from sim.device import check_device, kind_of
from sim.errors import SimulationDiverged
from sim.fem import ELEMENTS_DEFAULT, FINENESS_LEAST, PENALTY_MOST, Fem, Precision
from sim.fem.assembly import damping_time
from sim.fem.matrix import NODES_SIDE_BY_SIDE
from sim.fem.mesh import Mesh, meshes_of, outline_of
from sim.fem.outcome import checked, coarseness, more_wanted, required_by, wanted_of_overlap
from sim.fem.sizing import Sizes, coarser_than_required, stages_of
from sim.fem.stepping import Batch, Crossed, batch_key, path_of
from sim.result import Outcome, Result, force_scale, with_beginning
from sim.scene import Scene, beginning_of


@dataclass(slots=True)
class Required:
    """Needs of solutions on coarser meshes, by index of the scene and number of waypoints."""

    sizes: dict[tuple[int, int], Sizes] = field(default_factory=dict)
    stiffer: dict[tuple[int, int], str] = field(default_factory=dict)
    """Why a skin that does not stiffen has no solution."""

    def add(self, key: tuple[int, int], outcome: Outcome, sizes: Sizes) -> None:
        """Add what an outcome on a mesh of these sizes requires of a finer one."""
        if isinstance(outcome, Result):
            mesh, needed = outcome.record["mesh"], required_by(outcome)
            ratio = coarser_than_required(
                needed, outcome.surface_x, outcome.surface_y, mesh["fineness"]
            )
            if "made_anew" in mesh or ratio > COARSE:
                sizes = sizes.joined(needed)
            if "stiffening" not in outcome.record and mesh["fineness"] >= ROUGH:
                sizes = sizes.joined(wanted_of_overlap(outcome, OVERLAP_LASTS))
            elif mesh["fineness"] >= TELLING:
                self.stiffer[key] = outcome.record["stiffening"]["reason"]
        self.sizes[key] = sizes


def work_of(scene: Scene, numerics: Fem, required: Required) -> Array:
    """Return nodes and steps (2, S) of the meshes, one a stage, that `simulate_fem` begins with."""
    work = []
    for stage in stages_of(scene):
        sizes = required.sizes.get((0, stage.waypoints), stage.sizes)
        count, finest, _fineness = outline_of(scene, numerics, sizes)
        work.append((count, path_of(beginning_of(scene, stage.waypoints), numerics, finest).steps))
    return np.array(work, float).T


# Most times that a mesh is rebuilt because the solution shows that it was too coarse.
REMESHED = 2
# Fineness from which a skin without a state on a mesh is taken to have none on finer ones either: a
# rougher one stands at edges where no skin would.
TELLING = 0.3
# Least ratio by which elements of a rebuilt mesh are smaller where that is required: a mesh that is
# hardly finer is not worth its time.
REFINED = 1.2
# A mesh is rebuilt again if the last time multiplied what was coarse by less than this, or if the
# solution is of no use as it is.
LESS_COARSE = 0.9
# Fineness below which an overlap says nothing about finer meshes.
ROUGH = 0.2
# Element size over that required by the solution's own contact above which a finer mesh is built
# for that contact from the start.
COARSE = 1.25
# Overlap over the width above which a mesh 1.6 times as fine is expected to have one that is too
# large as well: it falls with the square of the elements' size.
OVERLAP_LASTS = 0.1


class _Onward:
    """Progress of attempts one after the other, each of which has all that is left of it."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._begin = self._done = 0.0

    def __call__(self, fraction: float) -> None:
        self._done = max(self._done, self._begin + (1.0 - self._begin) * fraction)
        if self._progress is not None:
            self._progress(self._done)

    def again(self) -> Progress:
        """Return it for the next attempt."""
        self._begin = self._done
        return self


def simulate_fem(
    scenes: Sequence[Scene],
    numerics: Fem = Fem(),
    *,
    device: str = "cpu",
    progress: Progress | None = None,
    required: Required | None = None,
) -> list[Outcome]:
    """Simulate presses and return the outcomes in their order: a result or the reason for none.

    Scenes with the same thickness, mesh topology and set of effects are solved in one batch.
    `required` is what solutions of the same scenes on coarser meshes required; to it is added what
    these require, as the next mesh is to have it: this one is not rebuilt for it.
    """
    check_device(device)
    if numerics.elements_max is None:
        numerics = replace(numerics, elements_max=ELEMENTS_DEFAULT[kind_of(device)])
    if not numerics.follows:
        outcomes = solve_on_meshes(scenes, numerics, None, device, progress)
        return [_judged(outcome) for outcome in outcomes]
    onward = _Onward(progress)
    stages = [stages_of(scene) for scene in scenes]
    parts = [(i, stage) for i, each in enumerate(stages) for stage in each]
    some = [beginning_of(scenes[i], stage.waypoints) for i, stage in parts]
    keys = [(i, stage.waypoints) for i, stage in parts]
    earlier = required or Required()
    sizes = [
        earlier.sizes.get(key, stage.sizes) for key, (_i, stage) in zip(keys, parts, strict=True)
    ]
    stiffens = [key in earlier.stiffer for key in keys]
    solved: dict[int, Outcome] = {}
    for stiffer in (False, True):
        rows = [row for row in range(len(keys)) if stiffens[row] == stiffer]
        if not rows:
            continue
        alike, wanted = [some[row] for row in rows], [sizes[row] for row in rows]
        if stiffer:
            failed = [SimulationDiverged(earlier.stiffer[keys[row]]) for row in rows]
            outcomes = solve_on_meshes(
                alike, numerics, wanted, device, onward.again(), failed=failed
            )
        else:
            outcomes = _following(alike, wanted, numerics, device, onward, anew=required is None)
            _on_coarser(outcomes, alike, wanted, numerics, device, onward)
        for row, outcome, size in zip(rows, outcomes, wanted, strict=True):
            solved[row] = outcome
            earlier.add(keys[row], outcome, size)
    of_scene: list[list[Outcome]] = [[] for _scene in scenes]
    for row, (i, _stage) in enumerate(parts):
        of_scene[i].append(_judged(solved[row]))
    return [_in_one(each) for each in of_scene]


def _judged(outcome: Outcome) -> Outcome:
    """Return `checked` of an outcome, and of what it has reached."""
    if isinstance(outcome, SimulationDiverged) and outcome.reached is not None:
        reached = checked(outcome.reached)
        outcome.reached = reached if isinstance(reached, Result) else None
    return checked(outcome)


def _in_one(stages: list[Outcome]) -> Outcome:
    """Return the result of all waypoints, its beginning replaced by solutions of later stages."""
    whole, *finer = stages
    for stage in finer:
        if isinstance(whole, SimulationDiverged):
            break
        if isinstance(stage, SimulationDiverged):
            whole = _without_finer(whole, stage)
        else:
            whole = with_beginning(whole, stage)
    return whole


def _without_finer(result: Result, failed: SimulationDiverged) -> Result:
    """Return a result whose contact needs a finer mesh, on which there is no solution."""
    failed.forget_dump()
    warning = f"the contact needs a finer mesh, which has no solution: {failed.reason}"
    mesh = {**result.record["mesh"], "finer_failed": True}
    warnings = [*result.record["warnings"], warning]
    return replace(result, record={**result.record, "mesh": mesh, "warnings": warnings})


def _following(
    scenes: Sequence[Scene],
    sizes: Sequence[Sizes],
    numerics: Fem,
    device: str,
    progress: _Onward,
    *,
    anew: bool,
) -> list[Outcome]:
    """Solve presses on meshes that follow their contacts, rebuilt where the solution needs more.

    Those with a result of use are rebuilt only if `anew` is set.
    """
    sizes = list(sizes)
    outcomes = solve_on_meshes(scenes, numerics, sizes, device, progress)
    coarse = np.full(len(scenes), np.inf)
    for attempt in range(1, REMESHED + 1):
        again: dict[Precision, list[int]] = {}
        for i, outcome in enumerate(outcomes):
            useful = isinstance(outcome, Result) and isinstance(checked(outcome), Result)
            if useful and not anew:
                continue
            if isinstance(outcome, Result) and "stiffening" not in outcome.record:
                more = more_wanted(outcome)
            elif isinstance(outcome, Crossed) and attempt == 1 and outcome.leaps:
                more = outcome.wanted
            else:
                continue
            if more is None or not refines(scenes[i], numerics, sizes[i], more, outcome):
                continue
            if isinstance(outcome, Result):
                before, coarse[i] = coarse[i], coarseness(outcome)
                if useful and coarse[i] >= LESS_COARSE * before:
                    continue
            sizes[i] = sizes[i].joined(more)
            again.setdefault(precision_for_finer(outcome, numerics), []).append(i)
        for precision, chosen in again.items():
            some = solve_on_meshes(
                [scenes[i] for i in chosen],
                replace(numerics, precision=precision),
                [sizes[i] for i in chosen],
                device,
                progress.again(),
            )
            for i, outcome in zip(chosen, some, strict=True):
                outcomes[i] = _remeshed(outcome, attempt, outcomes[i])
        if not again:
            break
    return outcomes


# Fineness, over the requested one, of the meshes on which presses without a solution are solved
# with a skin that stiffens from the start. A core takes minutes for the finest; a GPU takes about
# as long for all of them, if there is a solution, as there mostly is if only a later waypoint is
# without one.
COARSER = 1.0, 0.5, 0.25, 0.125


def _on_coarser(
    outcomes: list[Outcome],
    scenes: Sequence[Scene],
    sizes: Sequence[Sizes],
    numerics: Fem,
    device: str,
    progress: _Onward,
) -> None:
    """Replace outcomes without a solution by solutions on coarser meshes, where there are any."""
    if numerics.stiffening:
        return
    left: dict[int, SimulationDiverged] = {}
    for i, outcome in enumerate(outcomes):
        if isinstance(verdict := checked(outcome), SimulationDiverged):
            if verdict.reached is not None and isinstance(
                checked(verdict.reached), SimulationDiverged
            ):
                verdict.reached = None
            left[i] = verdict
    fast = kind_of(device) == "cuda"
    for coarser in COARSER:
        chosen = [i for i in left if coarser < 1 or (fast and _touched(left[i]))]
        if not chosen:
            continue
        some = solve_on_meshes(
            [scenes[i] for i in chosen],
            replace(numerics, fineness=max(FINENESS_LEAST, coarser * numerics.fineness)),
            [sizes[i] for i in chosen],
            device,
            progress.again(),
            failed=[left[i] for i in chosen],
        )
        for i, outcome in zip(chosen, some, strict=True):
            if isinstance(outcome, SimulationDiverged):
                continue
            before = left.pop(i)
            before.forget_dump()
            reached = before.reached
            outcomes[i] = outcome if reached is None else with_beginning(outcome, reached)
            if isinstance(verdict := checked(outcomes[i]), SimulationDiverged):
                left[i] = verdict


def _touched(failed: SimulationDiverged) -> bool:
    """True if a waypoint with contact was reached."""
    return failed.reached is not None and bool(failed.reached.force.any())


def refines(
    scene: Scene, numerics: Fem, sizes: Sizes, more: Sizes, result: Result | Crossed
) -> bool:
    """True if a mesh with `more` sizes is finer there than that of the result.

    At the limit on elements all of them are enlarged, so that a rebuilt mesh may not be.
    """
    (mesh,) = meshes_of([scene], numerics, [sizes.joined(more)])
    unit = scene.body.thickness
    before = coarser_than_required(more, result.surface_x, result.surface_y)
    return before > REFINED * coarser_than_required(more, mesh.x * unit, mesh.y * unit)


def precision_for_finer(result: Result | Crossed, numerics: Fem) -> Precision:
    """Return the precision for a finer mesh: float64 if `auto` already had to fall back to it."""
    double = numerics.precision == "auto" and result.record["precision"] == "float64"
    return "float64" if double else numerics.precision


def _remeshed(outcome: Outcome, times: int, before: Outcome) -> Outcome:
    """Return an outcome on a finer mesh, with the history of that `before`, which it replaces."""
    if isinstance(before, Crossed):
        before.forget_dump()
    if isinstance(outcome, SimulationDiverged):
        if isinstance(before, Result) and isinstance(checked(before), Result):
            return _without_finer(before, outcome)
        return outcome
    if not isinstance(before, Result | Crossed):
        return outcome
    record = {**outcome.record, "mesh": {**outcome.record["mesh"], "made_anew": times}}
    if record["precision"] == before.record["precision"] and "precision_reason" in before.record:
        record.setdefault("precision_reason", before.record["precision_reason"])
    return replace(outcome, record=record)


# Batches of presses that are solved at once, and the precision of each.

# Times that `auto` halves a step to a waypoint in float32 before it goes on in float64. Most such
# steps are limited by rounding, where forces or elements are small, and each costs as much as ten
# steps that converge.
HALVINGS_FLOAT32 = 1
# Most elements per batch: those that fit a CPU's cache or a GPU's memory.
ELEMENTS_SIDE_BY_SIDE = {"cpu": 20_000, "cuda": 20_000_000}
# Elements per thickness up to which `Fem.penalty` applies unchanged. With smaller elements
# contact is stiffer by the same factor, in powers of 2, because small contacts reach the same
# pressure over smaller depths.
SOFT_SHARE = 24
# Instantaneous over relaxed stiffness of a viscous body above which contact is made stiffer: with a
# ratio of 100 the indenter stood 10 % of its depth inside the skin.
STIFF_AT_ONCE = 4.0
# Stiffness of contact over the resistance of a body with inertia to a motion within a step, its
# density times the speed of a wave over the step.
IMPACT = 8.0


def solve_on_meshes(
    scenes: Sequence[Scene],
    numerics: Fem,
    sizes: Sequence[Sizes] | None,
    device: str,
    progress: Progress | None,
    *,
    failed: Sequence[SimulationDiverged] | None = None,
) -> list[Outcome]:
    """Solve presses on meshes of given sizes; skins that `failed` stiffen from the start."""
    began = time.perf_counter()
    meshes = meshes_of(scenes, numerics, sizes)
    meshed = (time.perf_counter() - began) / max(len(scenes), 1)
    outcomes: dict[int, Outcome] = {}
    for chosen in _batches(scenes, meshes, numerics, device):
        fraction = None
        if progress is not None:
            fraction = span_of(progress, len(outcomes), len(chosen), len(scenes))
        stiffer = replace(
            numerics, penalty=_penalty(scenes[chosen[0]], meshes[chosen[0]], numerics)
        )
        alike = [scenes[i] for i in chosen], [meshes[i] for i in chosen]
        if failed is None:
            some = _solve(*alike, stiffer, device, meshed * len(chosen), fraction)
        else:
            before = [failed[i] for i in chosen]
            some = _stiffened(*alike, stiffer, device, before, fraction)
        outcomes.update(zip(chosen, some, strict=True))
    return [outcomes[i] for i in range(len(scenes))]


def _penalty(scene: Scene, mesh: Mesh, numerics: Fem) -> float:
    """Return the contact stiffness on a mesh [E / T], more for a body stiffer in a short time."""
    finer = max(1.0, 1.0 / (SOFT_SHARE * mesh.finest)) if numerics.follows else 1.0
    viscosity, damped = scene.effects.viscosity, damping_time(scene, mesh)
    at_once = 1.0 if viscosity is None else 1.0 + sum(viscosity.ratios)
    stiffer = max(1.0, at_once / STIFF_AT_ONCE)
    if damped:
        path = path_of(scene, numerics, mesh.finest if numerics.follows else np.inf)
        impact = scene.body.wave_modulus / scene.body.modulus * damped / mesh.topmost
        stiffer *= max(1.0, IMPACT * impact / path.shortest / numerics.penalty)
    times = 2.0 ** (np.round(np.log2(finer)) + np.round(np.log2(stiffer)))
    return min(float(numerics.penalty * times), PENALTY_MOST)


def _batches(
    scenes: Sequence[Scene], meshes: Sequence[Mesh], numerics: Fem, device: str
) -> list[list[int]]:
    """Group scenes into batches of the same mesh topology and kernels, limited in size."""
    alike: dict[tuple[object, ...], list[int]] = {}
    for index, (scene, mesh) in enumerate(zip(scenes, meshes, strict=True)):
        key = batch_key(scene, mesh), _penalty(scene, mesh, numerics)
        alike.setdefault(key, []).append(index)
    most = ELEMENTS_SIDE_BY_SIDE[kind_of(device)]
    batches = []
    for group in alike.values():
        mesh = meshes[group[0]]
        fits = len(mesh.nodes) <= NODES_SIDE_BY_SIDE
        size = max(1, most // len(mesh.elements)) if fits else 1
        batches += [group[i : i + size] for i in range(0, len(group), size)]
    return batches


def _solve(
    scenes: Sequence[Scene],
    meshes: Sequence[Mesh],
    numerics: Fem,
    device: str,
    meshed: float,
    progress: Progress | None,
) -> list[Outcome]:
    """Solve one batch, in the requested precision or the one that it needs."""
    if numerics.precision != "auto":
        return Batch(scenes, meshes, numerics, numerics.precision, device, meshed, progress).run()
    trial = replace(numerics, halvings=min(numerics.halvings, HALVINGS_FLOAT32))
    batch = Batch(scenes, meshes, trial, "float32", device, meshed, progress)
    outcomes = batch.run()
    again = [i for i in range(len(outcomes)) if batch.may_go_on(i)]
    if again:
        reached = batch.reached(again)
        del batch  # frees its memory on the device
        some = [scenes[i] for i in again], [meshes[i] for i in again]
        retried = Batch(*some, numerics, "float64", device, meshed, progress, reached).run()
        for i, outcome in zip(again, retried, strict=True):
            failed = outcomes[i]
            if isinstance(failed, SimulationDiverged):
                failed.forget_dump()
            if isinstance(outcome, Result):
                reason = f"float32 did not converge: {failed}"
                outcome = replace(outcome, record={**outcome.record, "precision_reason": reason})
            outcomes[i] = outcome
    return outcomes


# Presses whose neo-Hookean skin has no state: they are solved with a skin that stiffens.

# Values of `Fem.stiffening`: the first two with a solution are compared. The last two are tried
# where one of the others has none.
STIFFENINGS = 3.0, 12.0, 40.0, 100.0
# A coefficient c adds c**STIFFER / (c**STIFFER + HALF) of the most that stiffening adds to a force:
# from 0.1 to 40 within 0.06 of it under a line, prism, cone and hexagon (benches of the paper's gel
# with friction, pressed by 30 % of the thickness), where a neo-Hookean skin has a state. Where skin
# stiffens far around, as under a ball half the thickness deep, it adds about half as much to the
# softer one, so that no force is changed by more than this fraction of it.
STIFFER, HALF, CORRECTED_MOST = 0.7, 1.8, 0.25


def _stiffened(
    scenes: Sequence[Scene],
    meshes: Sequence[Mesh],
    numerics: Fem,
    device: str,
    failed: Sequence[SimulationDiverged],
    progress: Progress | None,
) -> list[Outcome]:
    """Solve presses with two skins that stiffen; return `failed` of those without two solutions."""
    solved: list[list[Result]] = [[] for _scene in scenes]
    for stiffening in (STIFFENINGS[:2], STIFFENINGS[2:]):
        some = [
            (row, one) for row, each in enumerate(solved) if len(each) < 2 for one in stiffening
        ]
        if not some:
            break
        fits = len(meshes[0].nodes) <= NODES_SIDE_BY_SIDE
        outcomes = []
        for part in [some] if fits else [[one] for one in some]:
            batch = Batch(
                [scenes[row] for row, _one in part],
                [meshes[row] for row, _one in part],
                numerics,
                "float64",
                device,
                progress=progress,
                stiffening=[one for _row, one in part],
            )
            outcomes += batch.run()
            del batch  # frees its memory on the device
        for (row, one), outcome in zip(some, outcomes, strict=True):
            if isinstance(outcome, Result):
                record = {**outcome.record, "stiffening": {"coefficients": [one]}}
                solved[row].append(replace(outcome, record=record))
            else:
                outcome.forget_dump()
    return [
        _spread(each, before) if len(each) >= 2 else before
        for each, before in zip(solved, failed, strict=True)
    ]


def _spread(results: list[Result], before: SimulationDiverged) -> Result:
    """Return the softest of results with stiffer skins, with forces as of one that never stiffens.

    Sizes of forces are extrapolated from two coefficients, and tractions with them. All of that
    correction is their error, and the difference of both directions.
    """
    one, other, *_stiffest = results
    first = 0 if before.reached is None else len(before.reached.force)
    two = [each.record["stiffening"]["coefficients"][0] for each in results]
    added = [value**STIFFER / (value**STIFFER + HALF) for value in two]
    size = np.maximum(np.linalg.norm(one.force, axis=1), 1e-12)
    apart = np.linalg.norm(other.force, axis=1) / size - 1.0
    correction = apart * added[0] / (added[1] - added[0])
    within = np.clip(correction, -CORRECTED_MOST, CORRECTED_MOST)
    left = 1.0 - within
    traction = one.traction * left[:, None, None, None].astype(one.traction.dtype)
    whole = replace(one, wrench=one.wrench * left[:, None], traction=traction)
    aside = np.linalg.norm(other.force - one.force * (1.0 + apart[:, None]), axis=1)
    fraction = (np.abs(correction) * size + aside) / force_scale(one.force)
    entry = {
        "waypoint": first,
        "coefficients": two,
        "correction": [float(f"{value:.4g}") for value in fraction],
        "reason": before.reason,
    }
    warning = (
        f"from waypoint {first} on the skin stiffens where it is strained far, as a neo-Hookean "
        f"one has no state there ({before.reason}); forces are extrapolated from coefficients "
        f"{two[0]:g} and {two[1]:g} by up to {100 * np.abs(within).max():.2g} %"
    )
    warnings = [*one.record["warnings"], warning]
    return replace(whole, record={**one.record, "stiffening": entry, "warnings": warnings})
