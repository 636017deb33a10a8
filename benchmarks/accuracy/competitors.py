"""Solvers that are compared: tiers, meshes and precisions."""

from dataclasses import dataclass

import numpy as np

from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.layer import Layer
from sim.metrics import tolerance_of
from sim.mpm import Mpm
from sim.planning import plan
from sim.result import Outcome, Result
from sim.scene import Scene
from sim.tiers import simulate_many


@dataclass(frozen=True, slots=True)
class Competitor:
    """One solver with its settings: a step of a ladder."""

    label: str
    """Name of the step; competitors of one ladder differ only in fineness."""
    fineness: float
    """Fineness, which increases from coarse to fine."""
    solver: Layer | Fem | Mpm | str
    """A tier, or a tolerance for which the tier is planned."""

    def solve(self, scene: Scene, device: str) -> Outcome:
        """Solve a scene; a tolerance that cannot be met is no solution."""
        if not isinstance(self.solver, str):
            return simulate_many([scene], self.solver, device=device)[0]
        try:
            return plan(scene, self.solver, device=device).run()
        except (SimulationDiverged, SceneError) as error:
            return SimulationDiverged(str(error))


def ladders() -> dict[str, list[Competitor]]:
    """Return the competitors by ladder, each from coarse to fine.

    Labels have finenesses of meshes that follow the contact, tolerances that are met by error
    control, elements of uniform meshes, and cells of two particles a dimension.
    """
    default = Fem().fineness
    adapted = {one: f"fineness {one:g}" for one in (0.5, 1.0, 1.4)} | {default: "default"}
    within = ("5 %", "2 %", "1 %")
    elements = {size: Fem(spacing=size * 1e-3) for size in (1.25, 0.8, 0.5)}
    cells = {size: Mpm(cell=size * 1e-3) for size in (1.0, 0.8, 0.5, 0.4)}
    return {
        "layer": [Competitor("", 0.0, Layer())],
        "fem": [Competitor(adapted[one], one, Fem(fineness=one)) for one in sorted(adapted)],
        "fem float64": [Competitor("default", default, Fem(precision="float64"))],
        "tolerance": [Competitor(one, tolerance_of(one).value ** -0.5, one) for one in within],
        "fem even": [Competitor(f"{size:g} mm", 1e3 / size, elements[size]) for size in elements],
        "mpm": [Competitor(f"{size:g} mm", 1e3 / size, cells[size]) for size in cells],
        "mpm as published": [Competitor("", 0.0, Mpm.authors())],
    }


def elements_of(result: Result) -> int:
    """Return the number of elements, particles, or pixels."""
    mesh = result.record.get("mesh", {})
    return int(
        result.record.get("particles")
        or mesh.get("elements")
        or np.prod(result.traction.shape[1:3])
    )
