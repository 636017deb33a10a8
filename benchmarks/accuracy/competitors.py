"""Solvers that are compared: tiers, meshes and precisions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sim.errors import SceneError, SimulationDiverged
from sim.layer import Layer
from sim.metrics import tolerance_of
from sim.mpm import Mpm
from sim.planning import plan
from sim.result import Outcome
from sim.scene import Scene
from sim.tiers import simulate_many

# Maps a scene and a device to the outcome.
Solve = Callable[[Scene, str], Outcome]

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
    solve: Solve
    cpu_only: bool = False
    cpu_cases: tuple[str, ...] | None = None
    """Cases that are measured on a CPU; None: all. The others would take hours there."""

    @property
    def name(self) -> str:
        """Ladder and step."""
        return f"{self.ladder} {self.label}".strip()


def _layer(scene: Scene, _device: str) -> Outcome:
    return simulate_many([scene], Layer())[0]


def _fem(**chosen: Any) -> Solve:
    """Return a solver that calls `fem` with these fields of `Fem`."""

    def solve(scene: Scene, device: str) -> Outcome:
        from sim.fem import Fem

        return simulate_many([scene], Fem(**chosen), device=device)[0]

    return solve


def _within(tolerance: str) -> Solve:
    def solve(scene: Scene, device: str) -> Outcome:
        try:
            return plan(scene, tolerance, device=device).run()
        except SimulationDiverged as diverged:
            return diverged
        except SceneError as rejected:  # not attainable: reported as no solution
            return SimulationDiverged(str(rejected))

    return solve


def _mpm(cell: float | None) -> Solve:
    def solve(scene: Scene, device: str) -> Outcome:
        tier = Mpm.authors() if cell is None else Mpm(cell=cell)
        return simulate_many([scene], tier, device=device)[0]

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
