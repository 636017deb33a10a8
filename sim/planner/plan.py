"""The cheapest way to an answer within a tolerance, and why it is that one."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from sim.errors import SceneError, SimulationDiverged
from sim.fem.numerics import Grading, Numerics
from sim.metrics import outcome_of, worst_errors
from sim.planner import error_model as table_file
from sim.planner import seconds as seconds_file
from sim.planner.error_model import BAR_FLOOR, PROMISED, Model, fit
from sim.planner.features import (
    COARSER_BY,
    KINDS,
    LADDER,
    LAYER_COMPANION,
    WHAT,
    Choice,
    Kind,
    Probe,
    Tolerance,
    all_choices,
    probe,
    said,
    tolerance_of,
)
from sim.planner.seconds import SecondsModel, fit_seconds
from sim.result import Result
from sim.scene import Scene
from sim.tiers import simulate_one

_FOLLOWING = re.compile(r"(fineness|elements_max)=[^,]*, ")
"""Settings of meshes that follow the contact, which the table's do not."""


def conditions_text() -> str:
    """The settings of `fem` that errors depend on, as they are now."""
    return _FOLLOWING.sub("", repr(Numerics(grading=Grading())))


@dataclass(frozen=True, slots=True)
class Planner:
    """What plans are made from."""

    errors: Model
    seconds: SecondsModel
    numerics: str
    """The settings of `fem` that the table was measured with."""


@dataclass(frozen=True, slots=True)
class Offer:
    """A choice, and what is predicted of it."""

    choice: Choice
    error: float
    """That `PROMISED` of scenes like it stay below, in the tolerance's unit; inf where none is
    known."""
    seconds: float
    """Of the press alone, kernels compiled."""
    kind: Kind

    def __str__(self) -> str:
        """In words."""
        error = "no error known" if math.isinf(self.error) else said(self.kind, self.error)
        return f"{self.choice}: {error}, {self.seconds:.2g} s"


@dataclass(frozen=True, slots=True)
class Plan:
    """What is chosen for a scene."""

    tolerance: Tolerance
    device: str
    chosen: Offer
    cheaper: Offer | None
    """The dearest of those that are cheaper and miss the tolerance; None where none is cheaper."""
    dearer: Offer | None
    """The cheapest of those that take longer and miss less; None where nothing does."""
    offers: tuple[Offer, ...]
    """All of them, from cheap to dear."""
    group: str
    """Kind of scene whose spread of errors was added."""
    looked: Probe
    """The run of `layer` that the plan is read from."""
    notes: tuple[str, ...] = ()

    @property
    def within(self) -> list[Offer]:
        """Offers within the tolerance, from cheap to dear."""
        return [offer for offer in self.offers if offer.error <= self.tolerance.value]

    @property
    def why(self) -> str:
        """The choice, in a sentence or two."""
        share = f"{100 * PROMISED:g} of 100 scenes like this ({self.group})"
        text = f"{self.chosen}; {share} stay below that, and {self.tolerance} is asked for"
        if self.cheaper is not None:
            text += f". Cheaper is {self.cheaper}"
        if self.dearer is not None:
            text += f". Dearer is {self.dearer}"
        return text

    def record(self) -> dict[str, Any]:
        """What is kept with the result, as plain values."""
        return {
            "tolerance": str(self.tolerance),
            "chosen": str(self.chosen),
            "cheaper": None if self.cheaper is None else str(self.cheaper),
            "dearer": None if self.dearer is None else str(self.dearer),
            "group": self.group,
            "why": self.why,
            "notes": list(self.notes),
        }


def plan(
    scene: Scene, tolerance: str, device: str = "cpu", *, planner: Planner | None = None
) -> Plan:
    """The cheapest choice whose predicted error is within `tolerance`.

    Args:
        scene: What is to be simulated. One run of `layer` looks at it first.
        tolerance: Such as "2 %", "0.05 N", "0.5 px"; see `Tolerance`.
        device: Where `fem` would run.
        planner: What to plan with; the stored table unless given.

    Raises:
        SceneError: No tolerance, a scene beyond what the table covers, or a tolerance that nothing
            reaches: it names the best that is reached.
        SimulationDiverged: `layer` found no contact.
    """
    wanted = tolerance_of(tolerance)
    _check_effects(scene)
    planner = planner or stored()
    looked = probe(scene)
    _check_inside(planner.errors, looked)
    offers = _offers(planner, looked, wanted.kind, device)
    good = [offer for offer in offers if offer.error <= wanted.value]
    if not good:
        best = min(offers, key=lambda offer: (offer.error, offer.seconds))
        allowed = (
            "no tolerance for scenes of this kind"
            if math.isinf(best.error)
            else f"{said(wanted.kind, 1.001 * best.error)} or more"
        )
        raise SceneError(f"tolerance: {tolerance!r}; the best is {best}; allowed: {allowed}")
    chosen = good[0]
    place = offers.index(chosen)
    cheaper = offers[place - 1] if place else None
    more = [offer for offer in offers[place + 1 :] if offer.error < chosen.error]
    notes = []
    if planner.numerics != conditions_text():
        notes.append(
            "the cost table was measured with other settings of fem than today's: `python -m sim "
            "cost-table` measures it anew"
        )
    return Plan(
        tolerance=wanted,
        device=device,
        chosen=chosen,
        cheaper=cheaper,
        dearer=more[0] if more else None,
        offers=tuple(offers),
        group=looked.features.group,
        looked=looked,
        notes=tuple(notes),
    )


@functools.cache
def stored() -> Planner:
    """The planner of the stored table.

    Raises:
        SceneError: There is none.
    """
    for path in (table_file.TRAINING, seconds_file.STORED):
        if not path.exists():
            raise SceneError(
                f"tolerance: no cost table to plan with, {path} is not there; allowed: once "
                "`python -m benchmarks cost-table` has made it"
            )
    table = table_file.read(table_file.TRAINING)
    return Planner(
        fit(table), fit_seconds(table, seconds_file.read()), table.conditions["numerics"]
    )


def _check_effects(scene: Scene) -> None:
    for name in ("inertia", "gravity"):
        if getattr(scene.effects, name) is not None:
            raise SceneError(
                f"effects.{name}: {getattr(scene.effects, name)!r}; allowed with a tolerance: None "
                "(the cost table covers friction and viscosity)"
            )


def _check_inside(model: Model, looked: Probe) -> None:
    outside = model.outside(looked.features, "fem")
    if outside:
        said_ = "; ".join(
            f"{WHAT[name]} is {value:.3g}, allowed: {low:.3g} to {high:.3g}"
            for name, value, low, high in outside
        )
        raise SceneError(
            f"tolerance: this scene lies outside of what the cost table covers: {said_}; or choose "
            "tier and mesh yourself"
        )


def _offers(planner: Planner, looked: Probe, kind: Kind, device: str) -> list[Offer]:
    """Every choice that is known for such scenes, with its predictions, from cheap to dear."""
    scale = looked.scales[kind]
    features = looked.features
    known = planner.errors.choices()
    offers = []
    for choice in all_choices():
        if Choice(choice.tier, choice.cells) not in known:
            continue
        if planner.errors.outside(features, choice.tier):
            continue
        offers.append(
            Offer(
                choice=choice,
                error=scale * planner.errors.error(features, choice, kind),
                seconds=planner.seconds(features, choice, device),
                kind=kind,
            )
        )
    return sorted(offers, key=lambda offer: (offer.seconds, offer.error))


# Simulating within a tolerance, and the error bar that two meshes give.

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
    planner = planner or stored()
    scene = result.scene
    looked = known.looked if known is not None else probe(scene)
    numerics = numerics or Numerics()
    spacing = _coarser(result, numerics.spacing)
    second = simulate_one(scene, "fem", numerics=replace(numerics, spacing=spacing), device=device)
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
    from sim.fem.mesh import SPACING_SHARE

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
            result = simulate_one(
                scene, choice.tier, numerics=numerics, device=device, progress=progress
            )
        except SimulationDiverged as diverged:
            tried.append(f"{choice}: {diverged}")
            last = diverged
            continue
        return result, choice, tried
    raise last or SimulationDiverged("no choice to try")
