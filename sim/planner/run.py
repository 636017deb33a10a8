"""Simulating within a tolerance, and the error bar that two meshes give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sim.errors import SceneError, SimulationDiverged
from sim.metrics import outcome_of, worst_errors
from sim.planner.choices import COARSER_BY, LADDER, LAYER_COMPANION, Choice
from sim.planner.features import probe
from sim.planner.model import BAR_FLOOR, PROMISED
from sim.planner.plan import Plan, Planner, plan, stored
from sim.planner.tolerance import KINDS
from sim.result import Result
from sim.scene import Scene
from sim.simulate import simulate

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics

Progress = Callable[[float], None]


def simulate_within(
    scene: Scene,
    tolerance: str,
    *,
    device: str = "cpu",
    error_bar: bool = False,
    progress: Progress | None = None,
    planner: Planner | None = None,
) -> Result:
    """The scene simulated as cheaply as `tolerance` allows; `record["plan"]` says how and why.

    A choice that finds no solution is followed by the next dearer one within the tolerance.

    Args:
        scene: What is simulated.
        tolerance: Such as "2 %", "0.05 N", "0.5 px".
        device: Where `fem` runs.
        error_bar: Add `record["error_bar"]`; see `with_error_bar`.
        progress: Called with the share done, 0 to 1.
        planner: What to plan with; the stored table unless given.

    Raises:
        SceneError: See `plan`.
        SimulationDiverged: No choice within the tolerance found a solution.
    """
    chosen = plan(scene, tolerance, device, planner=planner)
    result, choice, tried = _solved(scene, chosen, device, progress)
    record = {**result.record, "plan": {**chosen.record(), "tried": tried}}
    result = replace(result, record=record)
    if error_bar:
        result = with_error_bar(
            result,
            device=device,
            numerics=choice.numerics(scene.body),
            planner=planner,
            known=chosen,
        )
    return result


def with_error_bar(
    result: Result,
    *,
    device: str = "cpu",
    numerics: Numerics | None = None,
    planner: Planner | None = None,
    known: Plan | None = None,
) -> Result:
    """The same result, with an error bar in `record["error_bar"]`; solves a coarser mesh once.

    The bar is the difference of the two meshes times a factor that covered the true error of
    `PROMISED` of the table's scenes of that kind; a `layer` result is held against a coarse mesh
    of `fem`. Keys: `force_share` (of the force, as `Tolerance` has it), `force` [N], `marker_rms`
    [px], largest over frames and axes; the differences, the factors, and the second mesh.

    Args:
        result: Of `layer` or `fem`.
        device: Where the second mesh is solved.
        numerics: Settings of `fem` that the result was made with.
        planner: What the factors are from; the stored table unless given.
        known: The plan, if there was one.

    Raises:
        SceneError: A scene beyond the table, or a mesh that has no coarser one.
        SimulationDiverged: The second mesh found no solution.
    """
    from sim.fem.numerics import Numerics

    planner = planner or stored()
    scene = result.scene
    looked = known.looked if known is not None else probe(scene)
    numerics = numerics or Numerics()
    spacing = _coarser(result, numerics.spacing)
    second = simulate(scene, "fem", numerics=replace(numerics, spacing=spacing), device=device)
    difference = worst_errors(outcome_of(result), outcome_of(second), scene.body)
    factor = {kind: planner.errors.bars[result.tier, looked.features.group, kind] for kind in KINDS}
    least = {kind: BAR_FLOOR[kind] * scale for kind, scale in looked.scales.items()}
    names = dict(zip(KINDS, ("force_share", "force", "marker_rms"), strict=True))
    bar: dict[str, Any] = {
        names[kind]: factor[kind] * max(difference[kind], least[kind]) for kind in KINDS
    }
    bar["difference"] = {names[kind]: difference[kind] for kind in KINDS}
    bar["factor"] = {names[kind]: factor[kind] for kind in KINDS}
    bar["covers"] = PROMISED
    bar["second_mesh"] = dict(second.record["mesh"], spacing=spacing)
    return replace(result, record={**result.record, "error_bar": bar})


def _coarser(result: Result, spacing: float | None) -> float:
    """Edge of an element of the second mesh [m], for a first one of `spacing`."""
    from sim.fem.window import SPACING_SHARE

    thickness = result.scene.body.thickness
    if result.tier == "layer":
        return thickness / LAYER_COMPANION
    first = thickness / SPACING_SHARE if spacing is None else spacing
    coarser = [thickness / cells for cells in LADDER if thickness / cells >= COARSER_BY * first]
    if not coarser:
        raise SceneError(
            f"error_bar: elements of {first * 1e3:.3g} mm; allowed: up to "
            f"{thickness / LADDER[0] / COARSER_BY * 1e3:.3g} mm, so that there is a coarser mesh"
        )
    return min(coarser)


def _solved(
    scene: Scene, chosen: Plan, device: str, progress: Progress | None
) -> tuple[Result, Choice, list[str]]:
    """The first solution of the offers within the tolerance, its choice, and what found none."""
    tried: list[str] = []
    last: SimulationDiverged | None = None
    order = [chosen.chosen, *(offer for offer in chosen.within if offer != chosen.chosen)]
    for offer in order:
        choice = offer.choice
        if choice.tier == "layer":
            return chosen.looked.result, choice, tried
        numerics = choice.numerics(scene.body)
        try:
            result = simulate(
                scene, choice.tier, numerics=numerics, device=device, progress=progress
            )
        except SimulationDiverged as diverged:
            tried.append(f"{choice}: {diverged}")
            last = diverged
            continue
        return result, choice, tried
    raise last or SimulationDiverged("no choice to try")
