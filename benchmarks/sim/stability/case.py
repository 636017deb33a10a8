"""A hard case: a named function that simulates something difficult and returns the laws it kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks.sim.stability.laws import Law
from sim.errors import SimulationDiverged
from sim.fem.numerics import Numerics
from sim.result import Result
from sim.scene import Scene
from sim.simulate import simulate_many


@dataclass(frozen=True, slots=True)
class Solver:
    """How cases call the `fem` tier."""

    device: str = "cpu"

    def numerics(self, spacing: float | None = 1e-3, **others: object) -> Numerics:
        """Numerics with this mesh; 1 mm is coarse, and laws of mechanics hold on it as well.

        None: the default, which follows the contact.
        """
        return Numerics(spacing=spacing, **others)  # type: ignore[arg-type]

    def one(self, scene: Scene, **numerics: object) -> Result:
        """The result of one scene.

        Raises:
            SimulationDiverged: There is none.
        """
        return self.many([scene], **numerics)[0]

    def many(self, scenes: Sequence[Scene], **numerics: object) -> list[Result]:
        """The results of scenes solved side by side.

        Raises:
            SimulationDiverged: One of them has none.
        """
        chosen = self.numerics(**numerics)  # type: ignore[arg-type]
        results = []
        for outcome in simulate_many(scenes, numerics=chosen, device=self.device):
            if isinstance(outcome, SimulationDiverged):
                raise outcome
            results.append(outcome)
        return results


Run = Callable[[Solver], list[Law]]


@dataclass(frozen=True, slots=True)
class Case:
    """A hard case; its name and what it asserts are its function's."""

    run: Run
    seconds: float
    """What it takes on one core of a laptop, roughly: sets the order and the time left."""

    @property
    def name(self) -> str:
        """As `--only` takes it."""
        return self.run.__name__.replace("_", "-")

    @property
    def group(self) -> str:
        """The file it stands in."""
        return self.run.__module__.rsplit(".", 1)[-1]

    @property
    def asserts(self) -> str:
        """What it asserts, in one sentence."""
        return (self.run.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
