"""Simulation within a tolerance: two meshes measure the error, and are refined until it is small.

Both meshes follow the contact, the coarser one with elements 1.6 times as long, which takes an
eighth of the time. The force of the result is extrapolated from both (Richardson 1911, order 2).
Its error is taken as a fraction of that correction, which held in presses solved independently
(`python -m benchmarks independent --tolerance "1 %"`). Surface and markers are those of the finer
mesh; their error is the difference of both times the fraction that remains at order 2.

Before any mesh `layer` is tried, which takes a tenth of a second. Its result is returned if its
estimate is below a tolerance of the force, in scenes on which it was checked (`sim.layer_within`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recorder.progress import part_of
from sim.error_estimate import measured, unknown_at_side, with_estimate
from sim.errors import SceneError, SimulationDiverged
from sim.extrapolation import left_of_difference, most_of_difference
from sim.layer_within import not_shown, solved_by_layer, why_trusted, worth_a_look
from sim.metrics import (
    Tolerance,
    force_scale,
    marker_errors,
    outcome_of,
    tolerance_of,
    with_unit,
    worst_errors,
)
from sim.result import ContactTier, Result
from sim.scene import Scene
from sim.symmetry import vanishing_share, with_symmetry
from sim.tiers import simulate_one

if TYPE_CHECKING:
    from sim.fem.numerics import Fem
    from sim.fem.solver import Required

Array = NDArray[np.float64]
Progress = Callable[[float], None]

# Length of the coarser mesh's elements over those of the finer one.
COMPANION = 1.6
# Error of an extrapolated force at fineness 1, with which the search begins.
EXPECTED = 0.009
# Range of the fineness with which the search begins.
FIRST_LEAST, FIRST_MOST = 0.6, 1.5
# Error of an extrapolated force over the correction. At an order of 1.3 instead of 2 the remaining
# error is 0.86 of it, at 3 half of it; the rest is for random errors.
LEFT = 1.0
# Least ratio of the two meshes' element counts along each axis. Below it their difference is no
# measure of the error, which for wide contacts lies in the layers and for narrow ones across the
# contact.
RATIO_LEAST = 1.2
# Least error of a force, over the force, that two meshes can measure.
FLOOR = 1e-3
# Out-of-balance force of the states over the allowed error of the force, and its maximum. Both
# meshes share the error of unbalanced states, so their difference does not show it: a sphere of
# radius 20 mm, 20 um deep in 4 mm, has a force 0.6 % off at 0.001 (2.6 % at 5 um), and less than
# 0.1 % off at 0.0003.
STATES, STATES_MOST = 0.01, 3e-4
# Error of a force over the out-of-balance force of its state, for light and wide contacts.
UNBALANCED = 10.0
# Error of a force that is not extrapolated, over the correction by extrapolation.
WHOLE = 1.5
# Error of markers over the remaining difference of both meshes.
MARKERS = 1.5
# Required elements over allowed ones above which a tolerance is not tried further.
HOPELESS = 8.0
# Most pairs of meshes that are tried.
ROUNDS = 4
# Fineness of a mesh over the requested one, below which the limit on elements was reached.
WHOLLY = 0.97
# Range of the ratio of fineness from one mesh to the next.
FINER_LEAST, FINER_MOST = 1.25, 2.0
# Elements beyond which a tolerance is rejected: a quarter of an hour on a CPU.
ELEMENTS_MAX = {"cpu": 250_000, "cuda": 2_000_000}


def simulate_within(
    scene: Scene,
    tolerance: str,
    *,
    tier: ContactTier | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Result:
    """Simulate by `layer` if its estimate is reliable, else on meshes until the error is small.

    `record["error"]` has the error and its kind: `estimated` for `layer`, `measured` for meshes.
    `record["plan"]` has the choice (`chosen`, `why`, `notes`), the earlier attempts (`tried`), and
    the total time (`seconds`).

    Args:
        scene: Scene to simulate.
        tolerance: Such as "2 %", "0.05 N", "0.5 px"; see `sim.metrics.Tolerance`.
        tier: `layer` or `fem`: only that one is tried. None: `layer` first, if its estimate was
            checked on such scenes (`sim.layer_within`), then `fem`.
        device: Device on which meshes are solved; `layer` runs on the CPU.
        progress: Called with the fraction done, 0 to 1, of `layer` and each mesh in turn.

    Raises:
        SceneError: The tolerance is invalid, or the finest mesh allowed does not reach it; with
            tier `layer`, it is below the estimate; the device does not exist; the indenter
            overlaps the side wall of a round body.
        SimulationDiverged: Two meshes of different fineness found no solution.
    """
    began = time.perf_counter()
    wanted = tolerance_of(tolerance)
    if wanted.kind == "fraction" and wanted.value < FLOOR:
        raise SceneError(
            f"tolerance: {tolerance!r}; allowed: {100 * FLOOR:g} % or more: meshes tell no less"
        )
    states = first_mesh(scene, wanted, device)
    fineness, most = states.fineness, states.elements_max
    meshes = _Meshes(scene, states, device, progress)
    tried: list[str] = []
    if tier == "layer" or (tier is None and worth_a_look(scene, wanted)):
        linear = _of_layer(scene, wanted, tier, tried, device, progress)
        if linear is not None:
            return _with_plan(linear, wanted, tried, began, why_trusted(linear))
    best: tuple[float, Result] | None = None
    for round_ in range(ROUNDS):
        try:
            coarse = meshes.solved(fineness / COMPANION, 0)
            fine = meshes.solved(fineness, 1)
        except SimulationDiverged as diverged:
            if round_ or meshes.limited:
                raise
            tried.append(f"fineness {fineness:.3g}: {meshes.given_up(diverged)}")
            fineness *= COMPANION
            continue
        limited = _fineness(fine) < WHOLLY * fineness
        if limited:
            coarse = meshes.solved(_fineness(fine) / COMPANION, 0)
        unknown = unknown_at_side(fine, measured=True)
        if unknown is not None:
            raise SceneError(f"tolerance: {tolerance!r}; {unknown['why']}")
        if least_ratio(coarse, fine) < RATIO_LEAST:
            tried.append(f"fineness {fineness:.3g}: no coarser mesh to measure by")
            if limited:
                break
            fineness *= COMPANION
            continue
        found, error = _of_both(coarse, fine, wanted, max(FLOOR, UNBALANCED * states.tolerance))
        tried.append(f"fineness {fineness:.3g}: {with_unit(wanted.kind, error)}")
        if best is None or error < best[0]:
            best = error, found
        if error <= wanted.value:
            return _with_plan(found, wanted, tried, began)
        finer = (error / wanted.value) ** 0.5 * 1.05
        if limited or fine.record["mesh"]["elements"] * finer**3 > HOPELESS * most:
            break
        fineness *= float(np.clip(finer, FINER_LEAST, FINER_MOST))
    allowed = "none" if best is None else f"{with_unit(wanted.kind, 1.001 * best[0])} or more"
    raise SceneError(f"tolerance: {tolerance!r}; tried: {'; '.join(tried)}; allowed: {allowed}")


def first_mesh(scene: Scene, wanted: Tolerance, device: str) -> Fem:
    """Return the settings of the finer mesh with which the search begins."""
    most = ELEMENTS_MAX["cpu" if device == "cpu" else "cuda"]
    fraction = wanted.value if wanted.kind == "fraction" else 0.01
    fineness = float(np.clip((EXPECTED / fraction) ** 0.5, FIRST_LEAST, FIRST_MOST))
    return replace(_states(scene, fraction), fineness=fineness, elements_max=most)


def _states(scene: Scene, fraction: float) -> Fem:
    """Return numerics with the tolerance of states for an allowed relative error of the force."""
    from sim.fem.numerics import Fem

    plain = Fem()
    tolerance = float(np.clip(STATES * fraction, plain.tolerance, STATES_MOST))
    effects = scene.effects
    if effects.viscosity is not None or effects.inertia is not None:
        return replace(plain, tolerance=tolerance)
    return replace(plain, tolerance=tolerance, path_tolerance=10 * tolerance)


class _Meshes:
    """Solutions of one scene on meshes of different fineness, each built from those before it."""

    def __init__(self, scene: Scene, states: Fem, device: str, progress: Progress | None) -> None:
        self._scene, self._states = scene, states
        self._device, self._progress = device, progress
        self._solved: list[Result] = []
        self._finest = np.inf
        self._required: Required = {}

    @property
    def limited(self) -> bool:
        """True if a mesh reached the limit on elements."""
        return self._finest < np.inf

    def given_up(self, diverged: SimulationDiverged) -> str:
        """Remove the dump of a failure that a finer mesh follows, and return its reason."""
        diverged.forget_dump()
        return str(diverged).split("; state:")[0]

    def solved(self, fineness: float, part: int) -> Result:
        """Return the solution on a mesh of about that fineness, from the cache or solved now.

        `part` is 0 or 1 of 2, for the progress. The mesh is coarser if it would have too many
        elements.
        """
        from sim.fem.solver import precision_for_finer, simulate_fem

        fineness = min(fineness, self._finest)
        for known in self._solved:
            if abs(_fineness(known) / fineness - 1) < 0.15:
                return known
        numerics = replace(self._states, fineness=fineness)
        if self._solved:
            finest = max(self._solved, key=_fineness)
            numerics = replace(numerics, precision=precision_for_finer(finest, numerics))
        (outcome,) = simulate_fem(
            [self._scene],
            numerics,
            device=self._device,
            progress=None if self._progress is None else part_of(self._progress, part, 2),
            required=self._required,
        )
        if isinstance(outcome, SimulationDiverged):
            raise outcome
        self._solved.append(with_estimate(outcome))
        if _fineness(outcome) < WHOLLY * fineness:
            self._finest = _fineness(outcome)
        return self._solved[-1]


def _fineness(result: Result) -> float:
    return float(result.record["mesh"]["fineness"])


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
        found, error, message = solved_by_layer(scene, wanted, progress=progress)
    except SimulationDiverged as diverged:
        if tier == "layer":
            raise
        tried.append(f"layer: {diverged}")
        return None
    unfit = None if tier == "layer" else not_shown(found)
    tried.append(unfit or message)
    if unfit is None and error <= wanted.value:
        return found
    if tier == "layer":
        allowed = "tier 'fem'"
        if np.isfinite(error):
            allowed = f"{with_unit(wanted.kind, 1.001 * error)} or more, or {allowed}"
        raise SceneError(f"tolerance: '{wanted}' with tier 'layer'; {message}; allowed: {allowed}")
    return None


def _of_both(coarse: Result, fine: Result, wanted: Tolerance, floor: float) -> tuple[Result, float]:
    """Return the result from two meshes, and its error in the unit of the tolerance.

    `floor` is the least stated error of the force, over the force.
    """
    ratio = elements_ratio(coarse, fine)
    left = left_of_difference(ratio)
    step = (fine.wrench - coarse.wrench) * left
    found = with_symmetry(replace(fine, wrench=fine.wrench + step))
    size = np.linalg.norm(found.force, axis=1)
    scale = force_scale(found.force)
    apart = np.abs(fine.force - coarse.force).max(axis=1)
    unsure = LEFT * most_of_difference(coarse, least_ratio(coarse, fine)) * apart
    newton = np.maximum(unsure, vanishing_share(found) * scale)
    fraction = np.maximum(newton / scale, floor * (size > 0))
    moved = marker_errors(outcome_of(fine), outcome_of(coarse), fine.scene.body)
    pixels = MARKERS * left * float(np.sqrt(np.mean(moved**2, axis=1)).max(initial=0.0))
    by = f"two meshes, elements {ratio:.2g} times as long in the coarser one"
    error = measured(
        found,
        fraction,
        by,
        newton=float(np.maximum(newton, floor * size).max(initial=0.0)),
        marker=pixels,
        second_mesh=dict(coarse.record["mesh"]),
    )
    value = {"fraction": error["percent"] / 100, "force": error["newton"], "marker": pixels}
    return replace(found, record={**found.record, "error": error}), float(value[wanted.kind])


def with_measured_error(result: Result, numerics: Fem, *, device: str = "cpu") -> Result:
    """Return the result with its error measured by a coarser mesh, also as `record["error_bar"]`.

    For a `layer` result it is the difference from a `fem` result plus the error that one states.

    Args:
        result: Result of `fem` or `layer`.
        numerics: Settings with which the elements were solved.
        device: Device on which the second mesh is solved.

    Raises:
        SceneError: The mesh is so coarse that there is no coarser one.
        SimulationDiverged: The second mesh found no solution.
    """
    unknown = unknown_at_side(result, measured=True)
    if unknown is not None:
        return replace(result, record={**result.record, "error": unknown})
    if result.tier == "layer":
        return _beside_elements(result, numerics, device)
    if numerics.follows:
        coarser = replace(numerics, fineness=result.record["mesh"]["fineness"] / COMPANION)
    else:
        from sim.fem.mesh import coarsest_spacing

        body = result.scene.body
        spacing = min(numerics.height(body) * COMPANION, coarsest_spacing(body))
        coarser = replace(numerics, spacing=spacing)
    second = simulate_one(result.scene, coarser, device=device)
    ratio = least_ratio(second, result)
    if ratio < RATIO_LEAST:
        cells = result.record["mesh"]["cells"]
        raise SceneError(
            f"error_bar: a mesh of {cells[0]} x {cells[1]} x {cells[2]} elements; allowed: a finer "
            "one, so that there is a coarser one to measure by"
        )
    left = WHOLE * left_of_difference(ratio)
    apart = worst_errors(outcome_of(second), outcome_of(result), result.scene.body)
    difference = np.abs(result.wrench - second.wrench)[:, :3].max(axis=1)
    size = np.linalg.norm(result.force, axis=1)
    scale = force_scale(result.force)
    fraction = np.maximum(left * difference / scale, FLOOR * (size > 0))
    error = measured(result, fraction, "a coarser mesh", second_mesh=dict(second.record["mesh"]))
    return _with_bar(result, error, left * apart["force"], left * apart["marker"])


def elements_ratio(coarse: Result, fine: Result) -> float:
    """Return the ratio of element lengths of both meshes, from their numbers."""
    return float(np.exp(np.mean(np.log(_ratios(coarse, fine)))))


def least_ratio(coarse: Result, fine: Result) -> float:
    """Return the ratio along the axis where it is least, which limits the measured errors."""
    return float(_ratios(coarse, fine).min())


def _ratios(coarse: Result, fine: Result) -> Array:
    counts = [np.array(one.record["mesh"]["cells"], float) for one in (coarse, fine)]
    return np.asarray(counts[1] / counts[0])


def _beside_elements(result: Result, numerics: Fem, device: str) -> Result:
    second = simulate_one(result.scene, numerics, device=device)
    apart = worst_errors(outcome_of(result), outcome_of(second), result.scene.body)
    own = second.record["error"]
    if own["status"] == "none":
        return replace(result, record={**result.record, "error": own})
    difference = np.abs(result.wrench - second.wrench)[:, :3].max(axis=1)
    fraction = difference / force_scale(second.force) + np.array(own["force"])
    mesh = dict(second.record["mesh"])
    error = measured(result, fraction, "elements, and what they state themselves", second_mesh=mesh)
    own_force = own["percent"] / 100 * np.linalg.norm(second.force, axis=1).max()
    return _with_bar(result, error, apart["force"] + own_force, apart["marker"])


def _with_bar(result: Result, error: dict[str, Any], force: float, marker: float) -> Result:
    """Return the result with its measured `error`, and a bar of force [N] and markers [px]."""
    bar = {
        "force_share": error["percent"] / 100,
        "force": force,
        "marker_rms": marker,
        "second_mesh": error["second_mesh"],
    }
    return replace(result, record={**result.record, "error": error, "error_bar": bar})


def _with_plan(
    result: Result, wanted: Tolerance, tried: list[str], began: float, *notes: str
) -> Result:
    plan = {
        "tolerance": str(wanted),
        "chosen": result.tier,
        "why": tried[-1],
        "tried": tried[:-1],
        "notes": list(notes),
        "seconds": round(time.perf_counter() - began, 4),
    }
    return replace(result, record={**result.record, "plan": plan})
