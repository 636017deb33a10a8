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
from benchmarks.hard_cases.random_scenes.referee import Held, held
from benchmarks.hard_cases.random_scenes.scenes import Drawn
from benchmarks.hard_cases.random_scenes.twins import KINDS, Twin, agrees, symmetric, twin_of
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.result import Outcome, Result
from sim.scene import Scene
from sim.tiers import simulate_many

Class = Literal["right", "refused", "diverged", "warned", "silent", "crash", "timeout"]
CLASSES: tuple[Class, ...] = get_args(Class)
# Acceptable for a user: a correct answer, or a message that there is none.
PASSED: frozenset[Class] = frozenset({"right", "refused", "diverged", "warned"})
# Default time limit of one solve, and the time after which it is called out again [s].
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
    (
        r"overlap|penetrat|passe?[sd]? through|inside the (indenter|gel|body)",
        r"no-overlap|no-crossing|not-through",
    ),
    (r"overlap|passe?[sd]? through|wall|narrow|too coarse", rf"{AMOUNTS}|touches|within-bounds"),
    (r"too coarse|too small|few elements|not resolved", rf"{AMOUNTS}|touches|within-bounds"),
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
    """Solver settings; `numerics` is the default of `simulate_many` except for precision."""

    device: str = "cpu"
    precision: Literal["auto", "float32", "float64"] = "auto"
    seconds: float = SECONDS

    def solve(self, scene: Scene) -> Outcome:
        """Solve a scene.

        Raises:
            OutOfTime: It took too long.
            SceneError: The scene is rejected.
        """
        numerics = Fem(precision=self.precision, elements_max=SOLVED_MAX)
        with time_limit(self.seconds):
            (outcome,) = simulate_many([scene], numerics, device=self.device)
        return outcome


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """Outcome of a scene."""

    kind: Class
    message: str = ""
    """Message of the solver or of Python."""
    broken: tuple[Held, ...] = ()
    """Laws that do not hold."""
    warnings: tuple[str, ...] = ()
    twin: str = ""
    """Twin that it was compared with."""
    laws: tuple[str, ...] = ()
    """Names of all laws that were measured."""
    scene: Scene | None = field(default=None, compare=False)

    @property
    def passed(self) -> bool:
        """True if the outcome is acceptable for a user."""
        return self.kind in PASSED

    @property
    def why(self) -> str:
        """One line with the broken laws, or the message."""
        return "; ".join(f"{each.name}: {each.law}" for each in self.broken) or self.message


def judge(drawn: Drawn, settings: Settings) -> SceneOutcome:
    """Solve a drawn scene, one in three also as a twin, and return its outcome."""
    if drawn.scene is None:
        return _unsolved(drawn.refusal or RuntimeError("neither a scene nor a refusal"))
    dice = Dice(drawn.seed, -1 - drawn.index)
    twin = None
    if dice.chance(TWINNED):
        twin = dice.one_of(sorted(KINDS))
    return judge_scene(drawn.scene, settings, twin)


def judge_scene(scene: Scene, settings: Settings, twin: str | None = None) -> SceneOutcome:
    """Solve a scene, and its twin of that name if it has one, and return the outcome."""
    try:
        outcome = settings.solve(scene)
        if isinstance(outcome, SimulationDiverged):
            return _unsolved(outcome, scene)
        found = held(outcome)
        if found[0].law.holds:
            found += symmetric(outcome)
        other = twin_of(scene, twin) if twin else None
        if other is not None:
            found += _compared(outcome, other, settings)
    except Exception as error:
        return _unsolved(error, scene)
    return of_laws(outcome, found, other.name if other else "")


def _compared(result: Result, twin: Twin, settings: Settings) -> list[Held]:
    other = settings.solve(twin.scene)
    if isinstance(other, SimulationDiverged):
        other.forget_dump()
        return []  # reported by the twin itself
    return [agrees(result, twin, other)]


def of_laws(result: Result, found: Sequence[Held], twin: str = "") -> SceneOutcome:
    """Return the outcome on a result from its laws and its own warnings."""
    warnings = tuple(str(each) for each in result.record.get("warnings", []))
    broken = tuple(each for each in found if not each.law.holds)
    kind: Class = "right"
    if broken:
        kind = "warned" if all(covered(each.name, warnings) for each in broken) else "silent"
    names = tuple(dict.fromkeys(each.name for each in found))
    return SceneOutcome(kind, "", broken, warnings, twin, names, result.scene)


def covered(law: str, warnings: Sequence[str]) -> bool:
    """Return True if any warning covers a violation of this law."""
    return any(
        re.search(words, warning, re.IGNORECASE) and re.fullmatch(laws, law)
        for warning in warnings
        for words, laws in COVERS
    )


def _unsolved(error: Exception, scene: Scene | None = None) -> SceneOutcome:
    """Return the outcome on an exception, which must state the error and the allowed range."""
    message = str(error)
    kind: Class = "crash"
    if isinstance(error, OutOfTime):
        kind = "timeout"
    elif isinstance(error, SceneError) and "allowed" in message:
        kind = "refused"
    elif isinstance(error, SimulationDiverged):
        error.forget_dump()
        kind = "diverged" if "waypoint" in message else "crash"
    if kind == "crash":
        frames = traceback.extract_tb(error.__traceback__)
        where = f" ({frames[-1].name}, line {frames[-1].lineno})" if frames else ""
        message = f"{type(error).__name__}: {message}{where}"
    return SceneOutcome(kind, message, scene=scene)


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
