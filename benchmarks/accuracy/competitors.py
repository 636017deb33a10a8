"""Solvers that are compared: tiers, meshes and precisions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from sim.errors import SceneError, SimulationDiverged
from sim.layer import Layer
from sim.metrics import tolerance_of
from sim.mpm import Mpm
from sim.planning import plan
from sim.result import Result
from sim.scene import Scene
from sim.tiers import simulate_many

Outcomes = list[Result | SimulationDiverged]
Outcome = TypeVar("Outcome")

# Finenesses of `fem` on contact-adapted meshes, besides the default.
FINENESS = (0.5, 1.0, 1.4)
# Requested tolerances, which the solver meets by error control.
TOLERANCES = ("5 %", "2 %", "1 %")
# Element sizes of `fem` on uniform meshes [m], coarse to fine.
EVEN_SPACINGS = (1.25e-3, 0.8e-3, 0.5e-3)
# Cell sizes of `mpm` [m], coarse to fine; two particles per cell and dimension.
MPM_CELLS = (1.0e-3, 0.8e-3, 0.5e-3, 0.4e-3)


@dataclass(frozen=True, slots=True)
class Competitor:
    """One solver with its settings."""

    ladder: str
    """Competitors of one ladder differ only in fineness and are joined by a line."""
    label: str
    """Name of its step on the ladder."""
    fineness: float
    """Fineness, which increases from coarse to fine."""
    solve: Callable[[Sequence[Scene], str], Outcomes]
    """Maps scenes and a device to their outcomes."""
    cpu_only: bool = False
    cpu_cases: tuple[str, ...] | None = None
    """Cases that are measured on a CPU; None: all. The others would take hours there."""

    @property
    def name(self) -> str:
        """Ladder and step."""
        return f"{self.ladder} {self.label}".strip()


def in_launches(
    solve: Callable[[Sequence[Scene], str], list[Outcome]], scenes: Sequence[Scene], device: str
) -> list[Outcome]:
    """Return the results of `solve` for `scenes`: one launch on a GPU, one by one on a CPU.

    A CPU computes sequentially in any case, so a launch of many scenes only makes the fast ones
    wait for the slow ones.
    """
    if device != "cpu":
        return solve(scenes, device)
    return [outcome for scene in scenes for outcome in solve([scene], device)]


def _layer(scenes: Sequence[Scene], _device: str) -> Outcomes:
    return simulate_many(scenes, Layer())


def _fem(**chosen: Any) -> Callable[[Sequence[Scene], str], Outcomes]:
    """Return a solver that calls `fem` with these fields of `Fem`."""

    def solve(scenes: Sequence[Scene], device: str) -> Outcomes:
        from sim.fem import Fem

        return simulate_many(scenes, Fem(**chosen), device=device)

    return solve


def _within(tolerance: str) -> Callable[[Sequence[Scene], str], Outcomes]:
    def solve(scenes: Sequence[Scene], device: str) -> Outcomes:
        outcomes: Outcomes = []
        for scene in scenes:
            try:
                outcomes.append(plan(scene, tolerance, device=device).run())
            except SimulationDiverged as diverged:
                outcomes.append(diverged)
            except SceneError as rejected:  # not attainable: reported as no solution
                outcomes.append(SimulationDiverged(str(rejected)))
        return outcomes

    return solve


def _mpm(cell: float | None) -> Callable[[Sequence[Scene], str], Outcomes]:
    def solve(scenes: Sequence[Scene], device: str) -> Outcomes:
        tier = Mpm.authors() if cell is None else Mpm(cell=cell)
        return simulate_many(scenes, tier, device=device)

    return solve


def competitors() -> list[Competitor]:
    """Return all competitors, each ladder from coarse to fine."""
    from sim.fem import Fem

    default = Fem().fineness
    everything = [Competitor("layer", "", 0.0, _layer, cpu_only=True)]
    for one in sorted({*FINENESS, default}):
        label = "default" if one == default else f"fineness {one:g}"
        everything.append(Competitor("fem", label, one, _fem(fineness=one)))
    everything.append(Competitor("fem float64", "default", default, _fem(precision="float64")))
    for text in TOLERANCES:
        fineness = tolerance_of(text).value ** -0.5
        everything.append(Competitor("tolerance", text, fineness, _within(text)))
    for spacing in EVEN_SPACINGS:
        label = f"{spacing * 1e3:.3g} mm"
        everything.append(Competitor("fem even", label, 1 / spacing, _fem(spacing=spacing)))
    for cell in MPM_CELLS:
        everything.append(Competitor("mpm", f"{cell * 1e3:.3g} mm", 1 / cell, _mpm(cell)))
    published = Competitor("mpm as published", "", 0.0, _mpm(None), cpu_cases=("sphere",))
    return [*everything, published]


def ladders() -> dict[str, list[Competitor]]:
    """Return the competitors by ladder, each from coarse to fine."""
    grouped: dict[str, list[Competitor]] = {}
    for one in competitors():
        grouped.setdefault(one.ladder, []).append(one)
    return grouped
