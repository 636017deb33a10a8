"""One scene, solved, judged and assigned to exactly one class."""

from __future__ import annotations

import re
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Literal, get_args

from benchmarks.hard_cases.random_scenes.dice import Dice
from benchmarks.hard_cases.random_scenes.referee import Named, measured
from benchmarks.hard_cases.random_scenes.scenes import Drawn
from benchmarks.hard_cases.random_scenes.twins import KINDS, agrees, symmetric, twin_of
from benchmarks.hard_cases.solver import Solver
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.result import Outcome, Result
from sim.scene import Scene

Class = Literal["right", "refused", "diverged", "warned", "silent", "crash", "timeout"]
CLASSES: dict[Class, str] = {
    "right": "all laws hold",
    "refused": "a `SceneError` names the wrong input and the allowed range",
    "diverged": "`SimulationDiverged` states the waypoint and the attempts",
    "warned": "laws are broken, and a warning of the result covers them",
    "silent": "laws are broken, without a warning",
    "crash": "any other exception",
    "timeout": "no answer within the time for one solve",
}
assert tuple(CLASSES) == get_args(Class)
# Outcomes that fail a run.
WRONG = frozenset({"silent", "crash"})
# After this time, a solve that ignored the end of its time is called out again [s].
AGAIN = 5.0
# Maximum number of elements, so that a scene takes seconds; coarsened meshes are reported.
SOLVED_MAX = 12_000
# Fraction of the scenes that are also solved as a twin.
TWINNED = 0.35

AMOUNTS = r"near-layer|rises|same-place|closed-loop|coulomb|symmetric|twin-.*|no-overlap"
# Words of a warning, and the laws that it covers: a warning that the force depends on the mesh does
# not cover an indenter that passes through the gel, or a missing force.
COVERS: tuple[tuple[str, str], ...] = (
    (r"edge radius .* below the element", AMOUNTS),
    (
        r"overlap|penetrat|passe?[sd]? through|inside the (indenter|gel|body)",
        r"no-overlap|no-crossing|not-through",
    ),
    (
        r"overlap|passe?[sd]? through|wall|narrow|too coarse|too small|few elements|not resolved",
        rf"{AMOUNTS}|touches|within-bounds",
    ),
    (r"base plane|below the base", r"above-base"),
    (r"buckle", rf"{AMOUNTS}|within-bounds"),
    # Elements that a round rim cuts through may bear what is just beside the rim.
    (r"reaches the rim of the round body", rf"{AMOUNTS}|touches|lets-go|within-bounds"),
    (r"its own image in the plane", r"symmetric"),
    (r"touch|light|round-off", r"touches|lets-go|same-place|within-bounds"),
)


class OutOfTime(Exception):
    """Raised if a solve takes too long."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Solver, and its time limit."""

    solver: Solver = field(default_factory=Solver)
    seconds: float = 60.0

    def solve(self, scene: Scene) -> Outcome:
        """Solve a scene.

        Raises:
            OutOfTime: It took too long.
            SceneError: The scene is rejected.
        """
        with time_limit(self.seconds):
            return self.solver.outcomes([scene], Fem(elements_max=SOLVED_MAX))[0]


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """Outcome of a scene."""

    kind: Class
    message: str = ""
    """Message of the solver or of Python."""
    laws: tuple[Named, ...] = ()
    """All laws that were measured."""
    warnings: tuple[str, ...] = ()
    twin: str = ""
    """Twin that it was compared with."""

    @property
    def broken(self) -> list[Named]:
        """Laws that do not hold."""
        return [(name, law) for name, law in self.laws if not law.holds]

    @property
    def failure(self) -> set[str]:
        """The broken laws that no warning covers, or the kind of crash."""
        if self.kind == "crash":
            return {self.message.split(":")[0]}
        silent = self.kind == "silent"
        return {name for name, _ in self.broken if silent and not covered(name, self.warnings)}

    @property
    def why(self) -> str:
        """One line with the broken laws, or the message."""
        return "; ".join(f"{name}: {law}" for name, law in self.broken) or self.message


def judge(drawn: Drawn, settings: Settings) -> SceneOutcome:
    """Solve a drawn scene, one in three also as a twin, and return its outcome."""
    if drawn.scene is None:
        return _unsolved(drawn.refusal or RuntimeError("neither a scene nor a refusal"))
    dice = Dice(drawn.seed, -1 - drawn.index)
    twin = dice.one_of(sorted(KINDS)) if dice.chance(TWINNED) else ""
    return judge_scene(drawn.scene, settings, twin)


def judge_scene(scene: Scene, settings: Settings, twin: str = "") -> SceneOutcome:
    """Solve a scene, and its twin of that name if it has one, and return the outcome."""
    try:
        outcome = settings.solve(scene)
        if isinstance(outcome, SimulationDiverged):
            return _unsolved(outcome)
        laws = measured(outcome)
        if laws[0][1].holds:
            laws += symmetric(outcome)
        other = twin_of(scene, twin) if twin else None
        if other is not None:
            answer = settings.solve(other.scene)
            if isinstance(answer, SimulationDiverged):
                answer.forget_dump()  # reported by the twin itself
            else:
                laws.append(agrees(outcome, twin, other, answer))
    except Exception as error:
        return _unsolved(error)
    return of_laws(outcome, laws, twin if other is not None else "")


def of_laws(result: Result, laws: Sequence[Named], twin: str = "") -> SceneOutcome:
    """Return the outcome on a result from its laws and its own warnings."""
    warnings = tuple(str(each) for each in result.record.get("warnings", []))
    outcome = SceneOutcome("silent", "", tuple(laws), warnings, twin)
    kind: Class = "silent" if outcome.failure else "warned" if outcome.broken else "right"
    return SceneOutcome(kind, "", tuple(laws), warnings, twin)


def covered(law: str, warnings: Sequence[str]) -> bool:
    """Return True if any warning covers a violation of this law."""
    return any(
        re.search(words, warning, re.IGNORECASE) and re.fullmatch(laws, law)
        for warning in warnings
        for words, laws in COVERS
    )


def _unsolved(error: Exception) -> SceneOutcome:
    """Return the outcome on an exception, which must state the error and the allowed range."""
    message = str(error)
    if isinstance(error, SimulationDiverged):
        error.forget_dump()
    if isinstance(error, OutOfTime):
        return SceneOutcome("timeout", message)
    if isinstance(error, SceneError) and "allowed" in message:
        return SceneOutcome("refused", message)
    if isinstance(error, SimulationDiverged) and "waypoint" in message:
        return SceneOutcome("diverged", message)
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].name}, line {frames[-1].lineno})" if frames else ""
    return SceneOutcome("crash", f"{type(error).__name__}: {message}{place}")


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` in the main thread if the block takes longer."""
    began = time.perf_counter()

    def ring(_number: int, _frame: FrameType | None) -> None:
        raise OutOfTime(f"no answer within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    # Again and again: an exception within a destructor is ignored.
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3), AGAIN)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    if time.perf_counter() - began > 2 * seconds:
        raise OutOfTime(f"no answer within {seconds:g} s")
