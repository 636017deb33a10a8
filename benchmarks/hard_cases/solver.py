"""The solver under test, as cases and referee call it; a wrong one is built by its arguments."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from benchmarks.hard_cases.laws import Laws, alike, evidence, validity_laws
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.result import Outcome, Result
from sim.scene import Scene
from sim.tiers import simulate_many


def _same(value: Any) -> Any:
    return value


@dataclass(frozen=True, slots=True)
class Solver:
    """The `fem` tier with the settings of a case; the other fields are for deliberate mistakes."""

    device: str = "cpu"
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings that replace those asked for."""
    solves: Callable[[Scene], Scene] = _same
    """Returns the scene that is solved in place of the one asked for."""
    answers: Callable[[Result], Result] = _same
    """Returns the result that is given in place of the solved one."""

    def outcomes(self, scenes: Sequence[Scene], numerics: Fem, **others: Any) -> list[Outcome]:
        """Solve scenes in one call."""
        outcomes = simulate_many(
            [self.solves(scene) for scene in scenes],
            replace(numerics, **self.settings),
            device=self.device,
            **others,
        )
        return [
            outcome
            if isinstance(outcome, SimulationDiverged)
            else self.answers(replace(outcome, scene=scene))
            for scene, outcome in zip(scenes, outcomes, strict=True)
        ]

    def many(self, scenes: Sequence[Scene], spacing: float = 1e-3, **numerics: Any) -> list[Result]:
        """Return the results of scenes solved in one call; SimulationDiverged if one has none."""
        results = []
        for outcome in self.outcomes(scenes, Fem(spacing=spacing, **numerics)):
            if isinstance(outcome, SimulationDiverged):
                raise outcome
            results.append(outcome)
        return results

    def one(self, scene: Scene, **numerics: Any) -> Result:
        """Return the result of one scene, as `many`."""
        return self.many([scene], **numerics)[0]


@dataclass(frozen=True, slots=True)
class Case:
    """A hard case: its claim in one sentence, and how scenes are solved and laws measured."""

    says: str
    laws: Callable[[Solver], Laws]


def by_hand(laws: Callable[[Solver], Laws]) -> Case:
    """Make a case of a function that calls the solver itself; its docstring says the assertion."""
    return Case((laws.__doc__ or "").split("\n")[0], laws)


def case(
    *scenes: Scene,
    says: str = "",
    variants: Sequence[Mapping[str, Any]] = ({},),
    det_f: float = 0.5,
    pull: float = 1e-6,
    or_none: bool = False,
    **numerics: Any,
) -> Callable[[Callable[..., Laws]], Case]:
    """Make a case of a function that returns the laws of the results of these scenes, in order.

    Without `says`, its docstring is its claim. The scenes are solved in one call for each
    variant of the numerics. The laws of every press are added, with `det_f` and `pull` as their
    limits. If `or_none`, there may be no solution, with evidence.
    """

    def made(laws: Callable[..., Laws]) -> Case:
        def judged(solver: Solver) -> Laws:
            try:
                solved = [solver.many(scenes, **numerics, **variant) for variant in variants]
            except SimulationDiverged as diverged:
                if not or_none:
                    raise
                return evidence(diverged)
            results = [result for each in solved for result in each]
            return [*validity_laws(*results, det_f=det_f, pull=pull), *laws(*results)]

        return Case(says or by_hand(laws).says, judged)

    return made


def same_as_alone(solver: Solver, scenes: Sequence[Scene]) -> Laws:
    """Yield the laws that scenes of one batch equal those solved alone, bit for bit."""
    for scene, result in zip(scenes, solver.many(scenes), strict=True):
        yield alike(solver.one(scene), result)
