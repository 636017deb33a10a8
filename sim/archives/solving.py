"""How the presses of an archive are solved, and what is tried where one finds no solution."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from sim.body import Body
from sim.checks import check_range
from sim.errors import SceneError, SimulationDiverged
from sim.result import Result
from sim.scene import Scene
from sim.simulate import simulate, simulate_many

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics

ArchiveTier = Literal["layer", "fem"]

SPACING_MAX = 1.2e-3
"""Largest element unless said otherwise [m]: the edges of a thick body's indenters ask for it."""


@dataclass(frozen=True, slots=True)
class Solving:
    """Tier and mesh, or the error that is accepted in place of both.

    Raises:
        SceneError: A value outside of what is allowed, or both.
    """

    tier: ArchiveTier = "fem"
    spacing: float | None = None
    """Height of an element [m]; None: as many as `cells` say, but 1.2 mm at most."""
    cells: int = 5
    """Elements that one thickness is high, without a spacing: 0.8 mm in the paper's gel."""
    for_edges: bool = True
    """Whether elements are narrower where the indenter comes (`sim.fem.grading.FOR_EDGES`)."""
    one_topology: bool = False
    """Whether all meshes of one call are alike, so that a GPU solves them in one launch."""
    tolerance: str | None = None
    """Such as "3 %": each press as cheaply as that allows; tier and mesh are then the planner's."""

    def __post_init__(self) -> None:
        if self.tier not in get_args(ArchiveTier):
            raise SceneError(f"solving.tier: {self.tier!r}; allowed: {get_args(ArchiveTier)}")
        if self.spacing is not None:
            check_range("solving", "spacing", self.spacing, 0.0, 1.0, unit="m", open_low=True)
            if self.tier == "layer" or self.tolerance is not None:
                given = "tier layer" if self.tolerance is None else "a tolerance"
                raise SceneError(f"solving.spacing: {self.spacing!r} m with {given}; allowed: None")
        check_range("solving", "cells", self.cells, 1, 1000)
        if self.tolerance is not None:
            if self.tier != "fem":
                raise SceneError(f"solving.tier: {self.tier!r} with a tolerance; allowed: none")
            from sim.planner import tolerance_of

            tolerance_of(self.tolerance)

    def numerics(self, body: Body) -> Numerics | None:
        """Settings of `fem` for a body; None for `layer`."""
        if self.tier == "layer":
            return None
        from sim.fem.grading import FOR_EDGES, Grading
        from sim.fem.numerics import Numerics

        spacing = self.spacing
        if spacing is None:
            spacing = min(body.thickness / self.cells, SPACING_MAX)
        return Numerics(
            spacing=spacing,
            grading=FOR_EDGES if self.for_edges else Grading(),
            one_topology=self.one_topology,
        )

    @property
    def scales_with_modulus(self) -> bool:
        """Whether forces may be scaled with the modulus: not where an error in newton is asked."""
        return self.tolerance is None or not self.tolerance.strip().endswith("N")


@dataclass(frozen=True, slots=True)
class Solved:
    """What became of one press."""

    result: Result | None
    """None where no attempt found a solution."""
    how: dict[str, Any]
    """How it was made, as plain values without times: what is kept with each of its frames."""


def solve(
    scenes: Sequence[Scene],
    solving: Solving,
    *,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> list[Solved]:
    """Solve scenes of bodies that are equally thick, each again in other ways if it must be.

    Raises:
        SceneError: What `simulate` refuses.
    """
    if solving.tolerance is not None:
        return [_within(scene, solving.tolerance, device) for scene in scenes]
    first = solving.numerics(scenes[0].body)
    outcomes = simulate_many(scenes, solving.tier, numerics=first, device=device, progress=progress)
    attempts = [] if first is None else _attempts(first, scenes[0].body)
    return [
        _again(scene, outcome, solving, attempts, device)
        for scene, outcome in zip(scenes, outcomes, strict=True)
    ]


def _attempts(first: Numerics, body: Body) -> list[tuple[str, Numerics]]:
    """What is tried after the first settings, in words and as settings."""
    careful = replace(
        first, precision="float64", step_travel=body.thickness / 100, newton_max=120, halvings=16
    )
    from sim.fem.grading import Grading

    return [
        ("steps of 1/100 of the thickness, float64", careful),
        (
            "even elements, steps of 1/100 of the thickness, float64",
            replace(careful, grading=Grading()),
        ),
    ]


def _again(
    scene: Scene,
    outcome: Result | SimulationDiverged,
    solving: Solving,
    attempts: Sequence[tuple[str, Numerics]],
    device: str,
) -> Solved:
    """The first solution: `outcome` itself, or that of one of `attempts`."""
    if isinstance(outcome, Result):
        return Solved(outcome, _how(outcome))
    failed = [_reason("as asked for", outcome)]
    for words, numerics in attempts:
        (outcome,) = simulate_many([scene], solving.tier, numerics=numerics, device=device)
        if isinstance(outcome, Result):
            return Solved(outcome, {**_how(outcome), "again": words, "failed": failed})
        failed.append(_reason(words, outcome))
    return Solved(None, {"tier": solving.tier, "device": device, "failed": failed})


def _within(scene: Scene, tolerance: str, device: str) -> Solved:
    """Solved by the planner's choices, which tries dearer ones by itself."""
    try:
        result = simulate(scene, tolerance=tolerance, device=device)
    except SimulationDiverged as diverged:
        failed = [_reason(f"within {tolerance}", diverged)]
        return Solved(None, {"tolerance": tolerance, "device": device, "failed": failed})
    how = {**_how(result), "tolerance": tolerance}
    tried = result.record["plan"]["tried"]
    return Solved(result, {**how, "failed": [_one_line(line) for line in tried]} if tried else how)


def _how(result: Result) -> dict[str, Any]:
    record = result.record
    how: dict[str, Any] = {
        "tier": result.tier,
        "mesh": record["mesh"].get("cells") or record["mesh"].get("grid"),
        "precision": record["precision"],
        "device": record["device"],
    }
    if result.tier == "layer":
        how["small strain"] = True
    return how


def _reason(attempt: str, diverged: SimulationDiverged) -> str:
    if diverged.dump is not None:
        # The provenance says all there is to say; a dump of every attempt would fill the disk.
        shutil.rmtree(diverged.dump.parent, ignore_errors=True)
    return f"{attempt}: {_one_line(str(diverged))}"


def _one_line(text: str) -> str:
    """The first line of a message, without the path of a dump: that differs from run to run."""
    return " ".join(text.split("state:")[0].split()).rstrip(" ;,.")


@functools.cache
def described(solving: Solving, body: Body) -> str:
    """How presses on a body are solved, in a few words."""
    if solving.tolerance is not None:
        return f"within {solving.tolerance}"
    numerics = solving.numerics(body)
    if numerics is None:
        return "layer (small strain)"
    shape = "for edges" if solving.for_edges else "even"
    return f"fem, elements {1e3 * (numerics.spacing or 0):.3g} mm high, graded {shape}"
