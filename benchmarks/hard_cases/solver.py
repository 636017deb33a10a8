"""The solver under test, as cases and referee call it; a wrong one is built by its arguments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from benchmarks.hard_cases.laws import Law, validity_laws
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

    def one(self, scene: Scene, **numerics: Any) -> Result:
        """Return the result of one scene, as `many`."""
        return self.many([scene], **numerics)[0]

    def many(
        self, scenes: Sequence[Scene], spacing: float | None = 1e-3, **numerics: Any
    ) -> list[Result]:
        """Return the results of scenes solved in one call.

        Elements of 1 mm are coarse, but laws of mechanics hold on them as well; with a spacing of
        None the mesh adapts to the contact, as by default.

        Raises:
            SimulationDiverged: One of them has no solution.
        """
        results = []
        for outcome in self.outcomes(scenes, Fem(spacing=spacing, **numerics)):
            if isinstance(outcome, SimulationDiverged):
                raise outcome
            results.append(outcome)
        return results


# A case: its docstring says what it asserts.
Case = Callable[[Solver], list[Law]]


def case(
    says: str,
    scenes: Sequence[Scene],
    laws: Callable[..., list[Law]],
    *,
    variants: Sequence[Mapping[str, Any]] = ({},),
    det_f: float | None = 0.5,
    pull: float = 1e-6,
    **numerics: Any,
) -> Case:
    """Return the case that scenes, solved in one call for each variant of numerics, obey laws.

    `laws` gets the results in this order. The laws of every press are added, with `det_f` and
    `pull` as their limits, unless `det_f` is None.
    """

    def judged(solver: Solver) -> list[Law]:
        results = [
            result for variant in variants for result in solver.many(scenes, **numerics, **variant)
        ]
        valid = [] if det_f is None else validity_laws(*results, det_f=det_f, pull=pull)
        return [*valid, *laws(*results)]

    judged.__doc__ = says
    return judged
