"""A hard case: a named function that simulates a difficult scene and returns the laws checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks.hard_cases.laws import Law
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.result import Result
from sim.scene import Scene
from sim.tiers import simulate_many


@dataclass(frozen=True, slots=True)
class Solver:
    """Settings with which cases call the `fem` tier."""

    device: str = "cpu"

    def numerics(self, spacing: float | None = 1e-3, **others: object) -> Fem:
        """Return settings with this mesh; 1 mm is coarse, but laws of mechanics hold on it as well.

        None: the default, which adapts to the contact.
        """
        return Fem(spacing=spacing, **others)  # type: ignore[arg-type]

    def one(self, scene: Scene, **numerics: object) -> Result:
        """Return the result of one scene.

        Raises:
            SimulationDiverged: No solution.
        """
        return self.many([scene], **numerics)[0]

    def many(self, scenes: Sequence[Scene], **numerics: object) -> list[Result]:
        """Return the results of scenes solved in parallel.

        Raises:
            SimulationDiverged: One of them has no solution.
        """
        chosen = self.numerics(**numerics)  # type: ignore[arg-type]
        results = []
        for outcome in simulate_many(scenes, chosen, device=self.device):
            if isinstance(outcome, SimulationDiverged):
                raise outcome
            results.append(outcome)
        return results


Run = Callable[[Solver], list[Law]]


@dataclass(frozen=True, slots=True)
class Case:
    """A hard case; its function gives its name and its assertion."""

    run: Run
    seconds: float
    """Approximate time on one core of a laptop; sets the order and the remaining time."""

    @property
    def name(self) -> str:
        """Name for `--only`."""
        return self.run.__name__.replace("_", "-")

    @property
    def group(self) -> str:
        """Name of the file that defines it."""
        return self.run.__module__.rsplit(".", 1)[-1]

    @property
    def asserts(self) -> str:
        """Its assertion, in one sentence."""
        return (self.run.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
