"""One scene, solved, judged and assigned to exactly one class."""

from __future__ import annotations

import re
import signal
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from benchmarks.hard_cases.random_scenes.dice import Dice
from benchmarks.hard_cases.random_scenes.referee import Named, measured
from benchmarks.hard_cases.random_scenes.scenes import Drawn
from benchmarks.hard_cases.random_scenes.twins import KINDS, agrees, symmetric, twin_of
from benchmarks.hard_cases.solver import Solver
from sim.errors import SceneError, SimulationDiverged
from sim.result import Result
from sim.scene import Scene

CLASSES = {
    "right": "all laws hold",
    "refused": "a `SceneError` names the wrong input and the allowed range",
    "diverged": "`SimulationDiverged` states the waypoint and the attempts",
    "warned": "laws are broken, and a warning of the result covers them",
    "silent": "laws are broken, without a warning",
    "crash": "any other exception",
    "timeout": "no answer within the time for one solve",
}
# Outcomes that fail a run.
WRONG = frozenset({"silent", "crash"})
# Time limit of a solve [s], and time after which one that ignored it is called out again.
SECONDS, AGAIN = 60.0, 5.0
# Maximum number of elements, so that a scene takes seconds; coarsened meshes are reported.
SOLVED_MAX = 12_000
# Fraction of the scenes that are also solved as a twin.
TWINNED = 0.35

AMOUNTS = r"near-layer|rises|same-place|closed-loop|coulomb|symmetric|twin-.*|no-overlap"
# Words of a warning, and the laws that it covers: a warning that the force depends on the mesh does
# not cover an indenter that passes through the gel, or a missing force.
COVERS: tuple[tuple[str, str], ...] = (
    (r"edge radius .* below the element", AMOUNTS),
    (r"inside the indenter|overlaps the", r"no-overlap|no-crossing|not-through"),
    (r"overlaps the side wall", rf"{AMOUNTS}|touches|within-bounds"),
    (r"below the base plane", r"above-base"),
    (r"may buckle", rf"{AMOUNTS}|within-bounds"),
    # Elements that a round rim cuts through may bear what is just beside the rim.
    (r"reaches the rim of the round body", rf"{AMOUNTS}|touches|lets-go|within-bounds"),
    (r"its own image in the plane", r"symmetric"),
)


class OutOfTime(Exception):
    """Raised if a solve takes too long."""


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """Outcome of a scene."""

    kind: str
    """One of `CLASSES`."""
    message: str = ""
    """Message of the solver or of Python."""
    laws: Sequence[Named] = ()
    """All laws that were measured."""
    silent: Sequence[str] = ()
    """Names of the broken laws that no warning covers."""

    @property
    def broken(self) -> list[Named]:
        """Laws that do not hold."""
        return [(name, law) for name, law in self.laws if not law.holds]

    @property
    def why(self) -> str:
        """One line with the broken laws, or the message."""
        return "; ".join(f"{name}: {law}" for name, law in self.broken) or self.message


RIGHT_SOLVER = Solver()


def judge(drawn: Drawn, solver: Solver = RIGHT_SOLVER, seconds: float = SECONDS) -> SceneOutcome:
    """Solve a drawn scene, one in three also as a twin, and return its outcome."""
    if drawn.scene is None:
        return _unsolved(drawn.refusal or RuntimeError("neither a scene nor a refusal"))
    dice = Dice(drawn.seed, -1 - drawn.index)
    twin = dice.one_of(sorted(KINDS)) if dice.chance(TWINNED) else ""
    return judge_scene(drawn.scene, twin, solver, seconds)


def judge_scene(
    scene: Scene, twin: str = "", solver: Solver = RIGHT_SOLVER, seconds: float = SECONDS
) -> SceneOutcome:
    """Solve a scene, and its twin of that name if it has one, and return the outcome."""

    def solved(scene: Scene) -> Result:
        with time_limit(seconds):
            return solver.one(scene, spacing=None, elements_max=SOLVED_MAX)

    try:
        result = solved(scene)
        laws = measured(result)
        if laws[0][1].holds:
            laws += symmetric(result)
        other = twin_of(scene, twin) if twin else None
        if other is not None:
            try:
                laws.append(agrees(result, twin, other, solved(other.scene)))
            except SimulationDiverged as diverged:
                diverged.forget_dump()  # it is no mistake of this scene
    except Exception as error:
        return _unsolved(error)
    return of_laws(result, laws)


def of_laws(result: Result, laws: Sequence[Named]) -> SceneOutcome:
    """Return the outcome on a result from its laws and its own warnings."""
    warnings = result.record.get("warnings", [])
    broken = {name for name, law in laws if not law.holds}
    silent = sorted(name for name in broken if not covered(name, warnings))
    kind = "silent" if silent else "warned" if broken else "right"
    return SceneOutcome(kind, "", laws, silent)


def covered(law: str, warnings: Sequence[str]) -> bool:
    """Return True if any warning covers a violation of this law."""
    return any(
        re.search(words, warning) and re.fullmatch(laws, law)
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
    place = "".join(traceback.format_tb(error.__traceback__)[-1:])
    return SceneOutcome("crash", f"{type(error).__name__}: {message} {' '.join(place.split())}")


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` in the main thread if the block takes longer."""

    def ring(_number: int, _frame: FrameType | None) -> None:
        raise OutOfTime(f"no answer within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    # Again and again: an exception within a destructor is ignored.
    signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
