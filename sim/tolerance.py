"""Simulation within a tolerance: two meshes measure the error, and are refined until it is small.

Both meshes follow the contact, the coarser one with elements 1.6 times as long, which takes an
eighth of the time. The discretisation error of a press falls about as the square of the elements'
size, so both give its size, and the force without it (Richardson 1911). The error of that force is
taken as a fraction of the correction, which held in presses solved independently (`python -m
benchmarks independent --only tolerance`). Surface and markers are those of the finer mesh; their
error is the difference of both times the fraction that remains at order 2.

Before any mesh `layer` is tried, which takes a tenth of a second. Its result is returned if its
estimate is below a tolerance of the force, in scenes like those on which it was checked: the
frictionless presses of `python -m benchmarks independent --only layer` that have an axis, and 30
more frictionless scenes by `fem` within 1.5 to 3 %: punches, boxes, bars, balls and shapes of the
catalogue, upright, tilted by up to 6 degrees, off-centre and sliding. The estimate covered all of
them; none of the 30 errors was more than 0.77 of it. tests/sim/test_tolerance_by_layer.py has some.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sim.arrays import Array, Progress
from sim.device import kind_of
from sim.error_estimate import (
    LAYER_LEAST,
    LAYER_PER_DEPTH,
    edge_errors,
    error_entry,
    estimated,
    fineness_of,
    further_errors,
    pixel_of,
    side_distance,
    steps_share,
    touched_edge,
    vanishing_share,
    waves_share,
    with_rounding,
    with_symmetry,
)
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.layer import Layer
from sim.metrics import Tolerance, marker_errors, outcome_of, tolerance_of, with_unit
from sim.result import ContactTier, Result, force_scale, from_json, to_json
from sim.scene import Scene
from sim.tiers import simulate

if TYPE_CHECKING:
    from sim.fem.in_time import TimeSteps

# Power of the elements' size with which the error falls: linear elements, smooth pressure.
ORDER = 2.0
# Fineness of the coarser mesh from which errors fall as the square of the elements' size. At half
# of it, the error may be twice as large, and so on up to that of order 1.
SQUARE_FROM = 0.375
# Length of the coarser mesh's elements over those of the finer one.
COMPANION = 1.6
# Error of an extrapolated force at fineness 1, with which the search begins.
EXPECTED = 0.009
# Range of the fineness with which the search begins.
FIRST_LEAST, FIRST_MOST = 0.6, 1.5
# Elements along the touched part of an edge from which errors fall as the square of their size:
# of flat punches and boxes with 2 elements there, extrapolated forces were off by 1.4 to 1.7 times
# the correction.
ALONG_EDGE = 4.0
# Least ratio of the two meshes' element counts along each axis. Below it their difference is no
# measure of the error, which for wide contacts lies in the layers and for narrow ones across the
# contact. Part of two meshes' difference, over the error of the finer one, that is no error of
# their size: where their nodes lie.
RATIO_LEAST, PLACED = 1.2, 0.5
# Least error of a force, over the force, that two meshes can measure.
FLOOR = 1e-3
# Out-of-balance force of the states over the allowed error of the force, and its maximum. Both
# meshes share the error of unbalanced states, so their difference does not show it: a sphere of
# radius 20 mm, 20 um deep in 4 mm, has a force 0.6 % off at 0.001 (2.6 % at 5 um), and less than
# 0.1 % off at 0.0003.
STATES, STATES_MOST = 0.01, 3e-4
# Error of a force over the out-of-balance force of its state, for light and wide contacts.
UNBALANCED = 10.0
# Least error of an extrapolated force by three meshes over that by two; and the most order by which
# their differences fall: two that agree better do so by chance.
CONVERGED, STEEPEST = 1 / 3, 3.0
# Error of markers over the remaining difference of both meshes.
MARKERS = 1.5
# Required elements over allowed ones above which a tolerance is not tried further, unless there is
# a time for it.
HOPELESS = 8.0
# Most meshes whose error is measured, and that if the time is limited.
ROUNDS, QUICK_ROUNDS = 5, 14
# Largest ratio of fineness by which the next mesh's error is measured.
APART_MOST = 2.2
# Fineness of a mesh over the requested one, below which the limit on elements was reached.
WHOLLY = 0.97
# Fraction of the tolerance for the error by time steps, of inertia.
IN_TIME = 1 / 3
# Fraction of a limited time that choosing those steps is expected to take and may take. Most
# fineness of the mesh for it: a rough one, on which a contact is not resolved, needs shorter steps.
CHOOSING, CHOOSING_MOST, CHOSEN_ON = 0.25, 0.5, 0.5
# Fineness of the first mesh if the time is limited, finer on a GPU, which takes no longer for it;
# the second follows if the first takes more than `FIRST` of the time, or has no state.
QUICK, FIRST = {"cpu": (0.25, 0.15), "cuda": (0.375, 0.15)}, 1 / 3
# Power of the nodes by which the time of a step grows: on a core about with them, on a GPU less, as
# launches count as well. Fraction of the time left that a mesh may take by it, and how much more
# with which a finer one is tried all the same; ratio of those compared.
TIME_POWER = {"cpu": 1.25, "cuda": 0.5}
SPENT, HOPE, FITTED = 0.7, 3.0, 0.93
# Range of the ratio of fineness from one mesh to the next.
FINER_LEAST, FINER_MOST = 1.25, 2.0
# Elements beyond which a tolerance is rejected: a quarter of an hour on a CPU.
ELEMENTS_MAX = {"cpu": 250_000, "cuda": 2_000_000}


def simulate_within(
    scene: Scene,
    tolerance: str,
    *,
    seconds: float | None = None,
    tier: ContactTier | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Result:
    """Simulate by `layer` if its estimate is reliable, else on meshes until the error is small.

    If that takes too long or no mesh is fine enough, the result has the least error of those that
    were computed. `record["error"]` has the error and its kind: `estimated` for `layer` and for a
    single mesh, `measured` for two. `record["plan"]` has the choice (`chosen`, `why`, `notes`),
    whether the tolerance was reached (`reached`), the earlier attempts (`tried`), the total time
    (`seconds`), and that by which `sim.replay` computes the same result again: the `settings` of
    its meshes, and the index of the one by which its error was measured (`companion`). Arguments
    are those of `sim.plan` (`tier` is its `only`) and of `Plan.run`.

    Raises:
        SceneError: The tolerance is below 0.1 %, or `tier` is `layer` and its error is larger.
        SimulationDiverged: There is no solution on any mesh, or none within the time.
    """
    began = time.perf_counter()
    wanted = tolerance_of(tolerance)
    if wanted.kind == "fraction" and wanted.value < FLOOR:
        raise SceneError(
            f"tolerance: {tolerance!r}; allowed: {100 * FLOOR:g} % or more: meshes tell no less"
        )
    tried: list[str] = []
    if tier == "layer" or (tier is None and layer_may_do(scene, wanted)):
        linear = _of_layer(scene, wanted, tier, tried, device, progress)
        if linear is not None:
            return _with_plan(linear, wanted, tried, began, _why_trusted(linear), settings=[])
    from sim.fem.stepping import OutOfTime, limited

    search = _Search(scene, wanted, device, progress, seconds, tried)
    try:
        with limited(search.until):
            search.run()
    except OutOfTime:
        tried.append(f"out of {seconds:g} s")
    except SimulationDiverged as diverged:
        if search.best is None:
            raise
        diverged.forget_dump()
        tried.append(diverged.reason)
    if search.best is None:
        raise SimulationDiverged(
            f"no solution in {seconds:g} s; tried: {'; '.join(tried)} (allowed: more seconds)"
        )
    value, result, settings, companion = search.best
    notes = [] if value <= wanted.value else [search.cost_of(value, wanted)]
    return _with_plan(
        result,
        wanted,
        tried,
        began,
        *notes,
        settings=settings,
        companion=companion,
        reached=value <= wanted.value,
    )


class _Chain:
    """Meshes of one scene, solved one after the other: each has the sizes that those before need.

    The results have the error by `steps` in time.
    """

    def __init__(self, scene: Scene, steps: TimeSteps | None, device: str) -> None:
        self._scene, self.steps, self._device = scene, steps, device
        from sim.fem.solver import Required

        self.required = Required()
        self.settings: list[Fem] = []
        self.results: list[Result] = []

    def solve(self, numerics: Fem, progress: Progress | None = None) -> Result:
        """Solve on the next mesh.

        Raises:
            SimulationDiverged: There is no solution on it.
        """
        from sim.fem.in_time import with_time
        from sim.fem.solver import precision_for_finer, simulate_fem

        if self.results:
            precision = precision_for_finer(self.results[-1], numerics)
            numerics = replace(numerics, precision=precision)
        (outcome,) = simulate_fem(
            [self._scene], numerics, device=self._device, progress=progress, required=self.required
        )
        outcome = estimated(with_time(outcome, self.steps, numerics))
        if isinstance(outcome, SimulationDiverged):
            raise outcome
        self.settings.append(numerics)
        self.results.append(outcome)
        return outcome

    def companion(self, of: int = -1) -> int | None:
        """Return the index of the coarser mesh that is expected to measure the least error."""
        fine, coarser = self.results[of], self.results[:of]
        some = [i for i, one in enumerate(coarser) if least_ratio(one, fine) >= RATIO_LEAST]
        return min(reversed(some), key=lambda i: _inflation(coarser[i], fine), default=None)

    def measured(self, companion: int | None, wanted: Tolerance) -> tuple[Result, float]:
        """Return the last result and its error in the unit of `wanted`, estimated or by two meshes.

        `companion` is the index of the other mesh; None: the error is estimated.
        """
        fine = self.results[-1]
        if companion is None:
            return fine, estimate_of(fine, wanted)
        floor = max(FLOOR, UNBALANCED * self.settings[-1].tolerance)
        third = self.companion(companion)
        coarsest = None if third is None else self.results[third]
        return extrapolated(self.results[companion], fine, wanted, floor, coarsest)


class _Search:
    """Meshes of one scene that become finer until the error is small or the time is over."""

    def __init__(
        self,
        scene: Scene,
        wanted: Tolerance,
        device: str,
        progress: Progress | None,
        seconds: float | None,
        tried: list[str],
    ) -> None:
        self._scene, self._wanted = scene, wanted
        self._device, self._progress, self._tried = device, progress, tried
        self._quick = QUICK[kind_of(device)]
        self.until = math.inf if seconds is None else time.monotonic() + seconds
        """Time of `time.monotonic` at which the search ends."""
        self.best: tuple[float, Result, list[Fem], int | None] | None = None
        """Least error so far, in the unit of the tolerance; its result, the settings of the meshes
        up to its own, and the index of the mesh by which the error was measured."""
        self._took, self._cost = (0.0, 1.0), 0.0
        """Time of the last mesh [s] and its fineness; and that time over its `_work`."""

    def run(self) -> None:
        """Solve until the tolerance is reached, or finer meshes are of no use.

        Raises:
            OutOfTime: The time is over.
            SimulationDiverged: There is no solution on a mesh.
        """
        from sim.fem.in_time import unmeasured
        from sim.fem.mesh import outline_of

        states = first_mesh(self._scene, self._wanted, self._device)
        fineness, limited = states.fineness, False
        moves = self._scene.effects.inertia is not None
        if moves:  # an answer before steps in time are chosen, which takes longer
            states = replace(states, step_factor=1)
            chain, solved = self._begun(unmeasured(self._scene), states, self._quick[-1:])
        else:
            chain, solved = self._begun(None, states, self._quick)
        steps = self._in_time(chain, states)
        if steps is not None and steps.factor > 1:
            states = replace(states, step_factor=steps.factor)
            chain, solved = self._begun(steps, states, self._quick)
        chain.steps = steps
        for _round in range(ROUNDS if self.until == math.inf else QUICK_ROUNDS):
            if self.until < math.inf:
                left = SPENT * (self.until - time.monotonic())
                least = FINER_LEAST * solved
                if self._cost * self._work(chain, replace(states, fineness=least)) > HOPE * left:
                    return self._tried.append("no time for a finer mesh")
                fineness = self._fitting(chain, replace(states, fineness=fineness), least, left)
            allowed = outline_of(self._scene, replace(states, fineness=fineness))[2]
            limited = limited or allowed < WHOLLY * fineness
            fineness = min(fineness, allowed)
            far = solved < fineness / APART_MOST
            nearer = fineness / COMPANION if far else fineness
            solved = self._solve(chain, replace(states, fineness=nearer))
            companion = chain.companion()
            error = math.inf if companion is None else self._offer(chain, companion)
            if far:
                continue
            if companion is None:
                self._tried.append(f"fineness {fineness:.3g}: no coarser mesh to measure by")
                if self.until == math.inf:
                    self._offer(chain, None)
                if limited:
                    return None
                fineness *= COMPANION
                continue
            if error <= self._wanted.value:
                return None
            finer = (error / self._wanted.value) ** 0.5 * 1.05
            elements = chain.results[-1].record["mesh"]["elements"] * finer**3
            hopeless = elements > HOPELESS * ELEMENTS_MAX[kind_of(self._device)]
            if limited or (hopeless and self.until == math.inf):
                return None
            fineness *= float(np.clip(finer, FINER_LEAST, FINER_MOST))
        return None

    def _begun(
        self, steps: TimeSteps | None, states: Fem, quick: Sequence[float]
    ) -> tuple[_Chain, float]:
        """Return a chain and the fineness of its first mesh: 0, without one, if no time is set.

        Of the `quick` ones it is the first that the time is enough for.
        """
        from sim.fem.stepping import OutOfTime, limited

        if self.until == math.inf:
            return _Chain(self._scene, steps, self._device), 0.0
        for fineness in quick[:-1]:
            chain, now = _Chain(self._scene, steps, self._device), time.monotonic()
            try:
                with limited(now + FIRST * (self.until - now)):
                    return chain, self._solve(chain, replace(states, fineness=fineness))
            except OutOfTime:
                self._tried.append(f"fineness {fineness:g}: out of its part of the time")
            except SimulationDiverged as diverged:
                diverged.forget_dump()
                self._tried.append(f"fineness {fineness:g}: {diverged.reason}")
        chain = _Chain(self._scene, steps, self._device)
        return chain, self._solve(chain, replace(states, fineness=quick[-1]))

    def _solve(self, chain: _Chain, numerics: Fem) -> float:
        """Solve on the next mesh, an answer if the time is limited; return its fineness."""
        began = time.perf_counter()
        work = self._work(chain, numerics)
        chain.solve(numerics, self._progress)
        self._took = time.perf_counter() - began, numerics.fineness
        self._cost = self._took[0] / work
        if self.until < math.inf:
            self._offer(chain, None)
        return numerics.fineness

    def _in_time(self, chain: _Chain, states: Fem) -> TimeSteps | None:
        """Return the time steps of inertia, and their error; None without it."""
        from sim.fem.in_time import FINENESS, FINER, time_steps
        from sim.fem.stepping import limited

        if self._scene.effects.inertia is None:
            return None
        wanted = self._wanted
        sought = IN_TIME * (wanted.value if wanted.kind == "fraction" else 0.01)
        now = time.monotonic()
        fineness, left = FINENESS, self.until - now
        if left < math.inf:
            most, seconds = replace(states, fineness=CHOSEN_ON), CHOOSING * left / (1 + FINER)
            fineness = self._fitting(chain, most, self._quick[-1], seconds)
        free = replace(states, step_factor=None)
        with limited(now + CHOOSING_MOST * left):
            return time_steps(self._scene, free, self._device, sought, fineness, chain.required)

    def _offer(self, chain: _Chain, companion: int | None) -> float:
        """Make the last result the best one if its error is the least; return that error.

        A measured error within the tolerance is better than any, as the least of several estimates
        is often too small; with inertia, for which these were not checked, so is any measured one.
        """
        result, error = chain.measured(companion, self._wanted)
        way = "estimated" if companion is None else "measured"
        words = with_unit(self._wanted.kind, error) if error < math.inf else "error not known"
        self._tried.append(f"fineness {chain.settings[-1].fineness:.3g}: {words}, {way}")
        moves, measured = self._scene.effects.inertia is not None, companion is not None
        best = self.best
        surer = measured and best is not None and moves and best[3] is None
        if best is None or error < best[0] or surer or (measured and error <= self._wanted.value):
            self.best = error, result, list(chain.settings), companion
        return error

    def _work(self, chain: _Chain, numerics: Fem) -> float:
        """Return steps times nodes to the `TIME_POWER` of the next mesh."""
        from sim.fem.solver import work_of

        nodes, steps = work_of(self._scene, numerics, chain.required)
        return float((steps * nodes ** TIME_POWER[kind_of(self._device)]).sum())

    def _fitting(self, chain: _Chain, numerics: Fem, least: float, seconds: float) -> float:
        """Return the fineness from `least` up to this one of a mesh that fits into this time."""
        fineness = max(numerics.fineness, least)
        while fineness > least:
            if self._cost * self._work(chain, replace(numerics, fineness=fineness)) <= seconds:
                break
            fineness = max(FITTED * fineness, least)
        return fineness

    def cost_of(self, error: float, wanted: Tolerance) -> str:
        """Return the cost of the tolerance, in words."""
        if self.best is None or error == math.inf:
            return f"{wanted} was not reached"
        finer = self.best[2][-1].fineness * (error / wanted.value) ** (1 / ORDER)
        seconds, last = self._took
        seconds *= (finer / last) ** (1 + 3 * TIME_POWER[kind_of(self._device)])
        return (
            f"{wanted} was not reached: {with_unit(wanted.kind, error)}; it needs a fineness of "
            f"about {finer:.2g}, which takes about {seconds:.2g} s here, if a mesh may be so fine"
        )


def replay(result: Result, *, device: str = "cpu") -> Result:
    """Compute a result of `plan(...).run()` again, by the settings in its `record["plan"]`.

    On the same device its numbers are bit for bit the same, however busy the machine is.

    Raises:
        SceneError: The result has no plan.
    """
    if "settings" not in result.record.get("plan", {}):
        raise SceneError("result: without a plan; allowed: a result of `plan(...).run()`")
    entry = result.record["plan"]
    settings = [from_json(Fem, one, "settings") for one in entry["settings"]]
    if not settings:
        again = simulate(result.scene, Layer())
    else:
        from sim.fem.in_time import TimeSteps

        steps = TimeSteps(**result.record["time"]) if "time" in result.record else None
        chain = _Chain(result.scene, steps, device)
        for numerics in settings:
            chain.solve(numerics)
        again, _error = chain.measured(entry["companion"], tolerance_of(entry["tolerance"]))
    return replace(again, record={**again.record, "plan": entry})


def estimate_of(result: Result, wanted: Tolerance) -> float:
    """Return the estimated error of a result in the unit of a tolerance; inf if it has none."""
    error = result.record["error"]
    if error["status"] == "none" or wanted.kind == "marker":
        return math.inf
    if wanted.kind == "fraction":
        return float(error["percent"]) / 100
    return float((np.array(error["force"]) * force_scale(result.force)).max(initial=0.0))


def first_mesh(scene: Scene, wanted: Tolerance, device: str) -> Fem:
    """Return the settings of the finer mesh with which the search begins."""
    fraction = wanted.value if wanted.kind == "fraction" else 0.01
    tolerance = float(np.clip(STATES * fraction, Fem().tolerance, STATES_MOST))
    timed = {"viscosity", "inertia"} & set(scene.effects.key)
    return Fem(
        fineness=float(np.clip((EXPECTED / fraction) ** 0.5, FIRST_LEAST, FIRST_MOST)),
        elements_max=ELEMENTS_MAX[kind_of(device)],
        tolerance=tolerance,
        path_tolerance=None if timed else 10 * tolerance,
    )


# `layer` in place of meshes, where its estimate was checked.

# Range of Poisson's ratio in which the estimate was checked.
POISSON = 0.3, 0.49
# Largest depth over thickness at which it was checked. `layer` itself has no such limit.
DEEPEST = 0.4
# Largest width of the contact over thickness at which it was checked: for a punch 40 times as wide
# at a Poisson's ratio of 0.3 the estimate is almost used up, 9.4 of 9.7 %.
WIDEST = 10.0


def layer_may_do(scene: Scene, wanted: Tolerance) -> bool:
    """True if `layer` was checked on such scenes, and may be accurate enough.

    Markers have no estimate. Scenes with friction are excluded, as the estimate covers presses but
    was hardly checked for shear. So are all other effects, domes, round bodies and indenters from a
    file.
    """
    body = scene.body
    least = LAYER_LEAST + LAYER_PER_DEPTH * scene.motion.depth_max / body.thickness
    return (
        wanted.kind != "marker"
        and (wanted.kind != "fraction" or least <= wanted.value)
        and not scene.effects.key
        and body.dome_radius is None
        and body.footprint == "rectangle"
        and scene.indenter.solid is None
        and POISSON[0] <= body.poisson <= POISSON[1]
        and 0 < scene.motion.depth_max <= (DEEPEST + 1e-9) * body.thickness
    )


def _why_trusted(result: Result) -> str:
    """Return the basis of the estimate of a `layer` result, in a sentence for the user."""
    thickness = result.scene.body.thickness
    width = float(result.quality.contact_width.max())
    side = side_distance(result)
    far = "no contact" if side is None else f"{side / thickness:.2g} thicknesses from any side"
    return (
        f"'layer' is linear and has no sides; here the depth is up to "
        f"{result.scene.motion.depth_max / thickness:.2g} of the thickness, the contact up to "
        f"{width / thickness:.2g} thicknesses or {width / pixel_of(result):.0f} pixels wide, and "
        f"{far}. Its error is estimated from these, not measured, and is that of the force alone"
    )


def _of_layer(
    scene: Scene,
    wanted: Tolerance,
    tier: ContactTier | None,
    tried: list[str],
    device: str,
    progress: Progress | None,
) -> Result | None:
    """Return the result of `layer`, or None if meshes are needed; append the attempt to `tried`."""
    from sim.device import ready_device

    if device != "cpu":
        ready_device(device)  # rejects an unknown device, as meshes would
    try:
        result = simulate(scene, Layer(), progress=progress)
    except SimulationDiverged as diverged:
        if tier == "layer":
            raise
        tried.append(f"layer: {diverged}")
        return None
    error, value = result.record["error"], estimate_of(result, wanted)
    width = float(result.quality.contact_width.max()) / scene.body.thickness
    if error["status"] != "estimated":
        message = f"layer: error not known, {error['why']}"
    elif wanted.kind == "marker":
        message = "layer: error of markers not known, only that of the force"
    else:
        newton = estimate_of(result, Tolerance("force", 1.0))
        result = replace(result, record={**result.record, "error": {**error, "newton": newton}})
        message = f"layer: {with_unit(wanted.kind, value)}, estimated"
    if tier == "layer" and value > wanted.value:
        allowed = "tier 'fem'"
        if np.isfinite(value):
            allowed = f"{with_unit(wanted.kind, 1.001 * value)} or more, or {allowed}"
        raise SceneError(f"tolerance: '{wanted}' with tier 'layer'; {message}; allowed: {allowed}")
    if tier is None and not result.force.any():
        message, value = "layer: no force at all", np.inf
    elif tier is None and width > WIDEST:
        message, value = (
            f"layer: the contact is {width:.3g} thicknesses wide, its estimate was checked up to "
            f"{WIDEST:g}",
            np.inf,
        )
    tried.append(message)
    return result if value <= wanted.value else None


def extrapolated(
    coarse: Result, fine: Result, wanted: Tolerance, floor: float, coarsest: Result | None = None
) -> tuple[Result, float]:
    """Return `fine` with the forces extrapolated from both meshes, and its error as a tolerance.

    Displacement and traction stay those of the finer mesh. `floor` is the least stated error of the
    force, over the force. `coarsest` is a third mesh to judge the extrapolation by.
    """
    ratio = elements_ratio(coarse, fine)
    left = left_of_difference(ratio)
    result = with_symmetry(_limit(coarse, fine))
    size = np.linalg.norm(result.force, axis=1)
    scale = force_scale(result.force)
    apart = np.abs(fine.force - coarse.force).max(axis=1)
    most = _most_of_difference(coarse, fine)
    unsure = most * apart
    if coarsest is not None:
        before = np.abs(coarse.force - coarsest.force).max(axis=1)
        least = (1.0 - ratio**-STEEPEST) / (elements_ratio(coarsest, coarse) ** STEEPEST - 1.0)
        apart = np.maximum(apart, least * before)
        limits = np.abs(result.force - _limit(coarsest, coarse).force).max(axis=1) / scale
        unsure = most * apart * _converged(limits, ratio, most * apart / scale)
    unsure = np.maximum(unsure, edge_errors(fine) * size)
    unsure, waves = _with_waves(coarse, fine, unsure / scale, apart / scale)
    newton = np.maximum(unsure, vanishing_share(result)) * scale
    further = further_errors(result, left_of_difference(ratio, order=1.0) * apart / scale)
    newton = newton + further * size + (steps_share(fine) + waves) * scale
    fraction = np.maximum(newton / scale, floor * (size > 0))
    moved = marker_errors(outcome_of(fine), outcome_of(coarse), fine.scene.body)
    pixels = MARKERS * left * float(np.sqrt(np.mean(moved**2, axis=1)).max(initial=0.0))
    by = f"two meshes, elements {ratio:.2g} times as long in the coarser one"
    error = error_entry(
        result,
        "measured",
        fraction,
        by,
        newton=float(np.maximum(newton, floor * size).max(initial=0.0)),
        marker=pixels,
        second_mesh=dict(coarse.record["mesh"]),
    )
    value = {"fraction": error["percent"] / 100, "force": error["newton"], "marker": pixels}
    return replace(result, record={**result.record, "error": error}), float(value[wanted.kind])


def _limit(coarse: Result, fine: Result) -> Result:
    """Return `fine` with the forces and torques that both meshes tend to (Richardson 1911)."""
    left = left_of_difference(elements_ratio(coarse, fine))
    return replace(fine, wrench=fine.wrench + (fine.wrench - coarse.wrench) * left)


def _converged(apart: Array, ratio: float, unsure: Array) -> float:
    """Return the error of extrapolated forces by three meshes, over that by two: `unsure`, at most.

    Those of two pairs of meshes are `apart`; what they still err by is less, if it falls at least
    as the elements' length, whose ratio is given. At least `CONVERGED`, and for all frames the
    same: in one of them both may agree by chance.
    """
    left = left_of_difference(ratio, order=1.0) * apart.max()
    return float(np.clip(left / max(float(unsure.max()), 1e-9), CONVERGED, 1.0))


def _with_waves(coarse: Result, fine: Result, unsure: Array, apart: Array) -> tuple[Array, Array]:
    """Return the error of meshes with that by waves, and of waves what is estimated (F,).

    Waves are damped over a time that falls with the elements' length. Where both meshes' times
    differ, so do the forces: `apart`, over the force, as `unsure`, the error of meshes. What an
    error of order 1 leaves of the largest difference is the largest error by waves, and in other
    frames in proportion to their estimates.
    """
    from sim.fem.in_time import with_neighbours

    waves = waves_share(fine)
    longer, shorter = (one.record["mesh"].get("damped", 0.0) for one in (coarse, fine))
    if not waves.any() or longer < RATIO_LEAST * shorter:
        return unsure, waves
    measured = with_neighbours(apart * left_of_difference(longer / shorter, order=1.0))
    measured = np.maximum(measured, waves * measured.max() / waves.max())
    return np.maximum(unsure, np.minimum(measured, waves)), np.zeros(len(waves))


def left_of_difference(ratio: float, order: float = ORDER) -> float:
    """Return the finer mesh's error over the difference of two meshes with this size `ratio`."""
    return 1.0 / (float(ratio**order) - 1.0)


def _most_of_difference(coarse: Result, fine: Result) -> Array:
    """Return the largest error of an extrapolated force over the difference of both (F,).

    It is `left_of_difference`, as the rest of a correction that is the whole of it covers orders
    of 1.3 to 3; more if the coarse mesh barely resolves the contact, or the fine one an edge.
    """
    ratio = least_ratio(coarse, fine)
    finest = fine.record["mesh"].get("finest", 0.0)
    at_edge = np.clip(ALONG_EDGE * finest / np.maximum(touched_edge(fine), 1e-9), 1.0, ratio)
    more = np.clip(SQUARE_FROM / fineness_of(coarse), at_edge, ratio + 1.0)
    return np.asarray(left_of_difference(ratio) * more)


def _inflation(coarse: Result, fine: Result) -> float:
    """Return the error that two meshes may measure, or miss, over that of the finer one.

    Meshes far apart miss most of an error that falls more slowly than its order.
    """
    ratio = elements_ratio(coarse, fine)
    rough = max(1.0, SQUARE_FROM / coarse.record["mesh"]["fineness"])
    missed = max(1.0, (ratio + 1.0) / (COMPANION + 1.0))
    apart = ratio**ORDER - 1.0 + PLACED
    return float(apart * rough * missed * left_of_difference(least_ratio(coarse, fine)))


def elements_ratio(coarse: Result, fine: Result) -> float:
    """Return the ratio of element lengths of both meshes, from their numbers."""
    return float(np.exp(np.mean(np.log(_ratios(coarse, fine)))))


def least_ratio(coarse: Result, fine: Result) -> float:
    """Return the ratio along the axis where it is least, which limits the measured errors."""
    return float(_ratios(coarse, fine).min())


def _ratios(coarse: Result, fine: Result) -> Array:
    counts = [np.array(one.record["mesh"]["cells"], float) for one in (coarse, fine)]
    return np.asarray(counts[1] / counts[0])


def _with_plan(
    result: Result,
    wanted: Tolerance,
    tried: list[str],
    began: float,
    *notes: str,
    settings: Sequence[Fem],
    companion: int | None = None,
    reached: bool = True,
) -> Result:
    plan = {
        "tolerance": str(wanted),
        "reached": reached,
        "chosen": result.tier,
        "why": tried[-1],
        "tried": tried[:-1],
        "notes": list(notes),
        "seconds": round(time.perf_counter() - began, 4),
        "settings": [to_json(one) for one in settings],
        "companion": companion,
    }
    return with_rounding(replace(result, record={**result.record, "plan": plan}))
