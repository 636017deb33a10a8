"""Gain of each optimisation: predicted with its reason, and measured by ablation."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from benchmarks.sim.speed.ablation import (
    without_gathering,
    without_graphs,
    without_prediction,
    without_rounding,
)
from benchmarks.sim.speed.roofline import CG_BYTES, WHOLE_CG_BYTES
from benchmarks.sim.speed.timing import Solve, fem
from sim.result import Outcome
from sim.scene import Scene

if TYPE_CHECKING:
    from sim.fem import Fem

Where = Literal["cpu", "gpu", "both"]

# Element size of a uniform mesh about as accurate as a graded one, over that of the graded one.
EVEN = 0.6
# Name of the baseline run.
AS_IT_IS = "as it is"
# Name of a step that CPUs once had too (docs/decisions/0032-linear-solves.md).
READ_HALF = "products read the tangent in float16"


@dataclass(frozen=True, slots=True)
class Step:
    """A step that an argument can leave out or include."""

    name: str
    where: Where
    predicted: str
    """Speed-up predicted before it was built."""
    reason: str
    solve: Callable[[Fem, str, int], Solve]
    """Returns the solver without it (with it: see `put_in`) for numerics, device and processes."""
    put_in: bool = False
    """True if the run `AS_IT_IS` is the one without the step."""
    title: str = ""
    """Name on the page, if it differs from the name in the records."""


def _changed(**values: Any) -> Callable[[Fem, str, int], Solve]:
    def solver(numerics: Fem, device: str, _processes: int) -> Solve:
        return fem(replace(numerics, **values), device)

    return solver


def _coarser_in_plan(numerics: Fem, device: str, _processes: int) -> Solve:
    from sim.fem import Grading

    return fem(replace(numerics, grading=Grading()), device)


def _even(numerics: Fem, device: str, _processes: int) -> Solve:
    spacing = None if numerics.spacing is None else EVEN * numerics.spacing
    return fem(replace(numerics, graded=False, spacing=spacing), device)


def _without(
    step: Callable[[], contextlib.AbstractContextManager[None]],
) -> Callable[[Fem, str, int], Solve]:
    def solver(numerics: Fem, device: str, _processes: int) -> Solve:
        return _inside(step, fem(numerics, device))

    return solver


def _shared(numerics: Fem, device: str, processes: int) -> Solve:
    return fem(numerics, device, processes)


def _one_by_one(numerics: Fem, device: str, _processes: int) -> Solve:
    solve = fem(numerics, device)

    def each(scenes: Sequence[Scene], progress: Callable[[float], None]) -> list[Outcome]:
        found: list[Outcome] = []
        for scene in scenes:
            found += solve([scene], lambda _share: None)
            progress(len(found) / len(scenes))
        return found

    return each


STEPS = (
    Step(
        "elements finer in plan than over the depth",
        "both",
        "below 1",
        "more elements where edges need them, which reduces the error at little cost",
        _coarser_in_plan,
    ),
    Step(
        "graded mesh",
        "both",
        "about 1",
        "hardly fewer elements than a uniform mesh of the same height: see the errors",
        _changed(graded=False),
    ),
    Step(
        "graded mesh, against an even one of 3/5 the size",
        "both",
        "2-3",
        "time of a uniform mesh as accurate as the graded one: see the errors",
        _even,
    ),
    Step(
        "soft contact, brought up to its answer",
        "both",
        "2-3 with prediction",
        "fewer Newton iterations: a stiff contact changes its set of touching points each time",
        _changed(penalty=1000.0, augmentations=0),
        title="augmented-Lagrangian contact",
    ),
    Step(
        "states as exact as meshes are",
        "both",
        "1.3-2",
        "tolerances of 1.5 % where they are kept, 10 % on the way, not 0.1 % and 1 %; one "
        "multiplier update, not two: the remaining residual is far below the mesh's error",
        _changed(tolerance=1e-3, path_tolerance=1e-2, augmentations=2),
        title="tolerances matched to the mesh error",
    ),
    Step(
        "prediction of the next state",
        "both",
        "2-3 with soft contact",
        "fewer Newton iterations: a step begins at an extrapolated state",
        _without(without_prediction),
    ),
    Step(
        "two processes on two cores",
        "cpu",
        "up to 2",
        "presses are independent; start-up of processes and shared resources cost some",
        _shared,
        put_in=True,
    ),
    Step(
        "presses side by side",
        "gpu",
        "up to the number of presses",
        "one press does not fill a GPU; each advances with its own steps, so the total is the "
        "slowest press, not the sum of the slowest steps",
        _one_by_one,
        title="presses in one batch",
    ),
    Step(
        "one mesh topology for all",
        "gpu",
        "up to the number of mesh groups",
        "presses whose meshes have different numbers of elements cannot share a launch",
        _changed(one_topology=False),
    ),
    Step(
        "graph capture",
        "both",
        "up to 5 where launches take most of the time",
        "about 10 us a launch without, 2 us recorded, on a GPU; 50 us of Python on a CPU",
        _without(without_graphs),
    ),
    Step(
        "no rows launched for what has ended",
        "gpu",
        "1.1-1.2",
        "an iteration in which few presses run is some 100 us of empty threads for all others",
        _without(without_gathering),
        title="no threads launched for finished presses",
    ),
    Step(
        READ_HALF,
        "gpu",
        "1.1-1.3",
        f"{CG_BYTES} bytes per node and iteration instead of {WHOLE_CG_BYTES}; as many iterations",
        _without(without_rounding),
    ),
)


def steps_on(device: str) -> list[Step]:
    """Return the steps that apply to a device."""
    kind = "cpu" if device == "cpu" else "gpu"
    return [step for step in STEPS if step.where in ("both", kind)]


def _inside(without: Callable[[], contextlib.AbstractContextManager[None]], solve: Solve) -> Solve:
    def solve_without(scenes: Sequence[Scene], progress: Callable[[float], None]) -> list[Outcome]:
        with without():
            return solve(scenes, progress)

    return solve_without
