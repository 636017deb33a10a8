"""Part `mistakes`: solvers built wrong on purpose, each of which a case must notice."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from benchmarks.hard_cases.cases import CASES
from benchmarks.hard_cases.named_cases import escaped, judge
from benchmarks.hard_cases.solver import Solver
from benchmarks.report import Page, Run, table
from sim.result import Result
from sim.scene import Friction, Gravity, Scene


def _effects(**changes: Any) -> Callable[[Scene], Scene]:
    """Return what solves scenes with some effects replaced."""
    return lambda scene: replace(scene, effects=replace(scene.effects, **changes))


def _rougher(scene: Scene) -> Scene:
    friction = scene.effects.friction
    doubled = friction and Friction(min(2 * friction.coefficient, 10.0))
    return replace(scene, effects=replace(scene.effects, friction=doubled))


def _upside_down(scene: Scene) -> Scene:
    gravity = scene.effects.gravity
    if gravity is None:
        return scene
    x, y, z = gravity.acceleration
    return replace(scene, effects=replace(scene.effects, gravity=Gravity((-x, -y, -z))))


def _compressible(scene: Scene) -> Scene:
    return replace(scene, body=replace(scene.body, poisson=0.3))


def _scaled(result: Result) -> Result:
    return replace(result, wrench=1.1 * result.wrench)


def _aside(result: Result) -> Result:
    return replace(result, wrench=result.wrench * [-1, 1, 1, 1, 1, 1])


def _locking(result: Result) -> Result:
    """Stiffen as linear elements with full integration do: 33 % at Poisson's ratio 0.49."""
    factor = 1 + 0.0066 / (1 - 2 * result.scene.body.poisson)
    return replace(result, wrench=factor * result.wrench, traction=factor * result.traction)


def _skipping(result: Result) -> Result:
    """Give each odd frame as the one before it."""
    frames = [frame - frame % 2 for frame in range(len(result.wrench))]
    return replace(
        result,
        wrench=result.wrench[frames],
        surface=result.surface[frames],
        traction=result.traction[frames],
    )


@dataclass(frozen=True, slots=True)
class Mistake:
    """A wrong solver, and the case that notices it."""

    what: str
    case: str
    """The fastest case that fails with it."""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the solver that make it wrong."""

    def solver(self, device: str) -> Solver:
        """Return the wrong solver."""
        return Solver(device, **self.arguments)


MISTAKES = {
    "force-scaled": Mistake(
        "forces of 1.1 times the right ones", "flat-punch-between-bounds", {"answers": _scaled}
    ),
    "locking": Mistake(
        "forces of elements that lock near nu = 0.5", "poisson-0-49", {"answers": _locking}
    ),
    "pushes-outwards": Mistake(
        "the force along x has the other sign", "rim-10-mm", {"answers": _aside}
    ),
    "frames-skipped": Mistake(
        "each second frame repeats the one before", "reload-after-unload", {"answers": _skipping}
    ),
    "poisson-0-3": Mistake(
        "every gel has Poisson's ratio 0.3", "sags-under-gravity", {"solves": _compressible}
    ),
    "friction-ignored": Mistake(
        "no friction", "full-stick-stiffens", {"solves": _effects(friction=None)}
    ),
    "friction-doubled": Mistake(
        "twice the coefficient of friction", "shear-friction-0-3", {"solves": _rougher}
    ),
    "viscosity-ignored": Mistake(
        "no viscosity", "fast-and-slow-presses", {"solves": _effects(viscosity=None)}
    ),
    "inertia-ignored": Mistake(
        "no inertia", "fast-press-with-mass", {"solves": _effects(inertia=None)}
    ),
    "gravity-upwards": Mistake(
        "gravity with the other sign", "sags-under-gravity", {"solves": _upside_down}
    ),
    "loose-tolerance": Mistake(
        "a tenth of the force may be out of balance",
        "tighter-tolerance",
        {"settings": {"tolerance": 0.1}},
    ),
    "soft-contact": Mistake(
        "contact a 25th as stiff, without updates of its multipliers",
        "flat-punch-between-bounds",
        {"settings": {"penalty": 8.0, "augmentations": 0}},
    ),
    "float32-only": Mistake(
        "never more digits than float32",
        "tighter-tolerance",
        {"settings": {"precision": "float32"}},
    ),
}
# Those of a quick run.
QUICK = ("force-scaled", "gravity-upwards", "loose-tolerance")


def measure(run: Run) -> dict[str, Any]:
    """Judge each wrong solver by the case that must notice it."""
    names = QUICK if run.quick else tuple(MISTAKES)
    noticed = {}
    for done, name in enumerate(names, start=1):
        mistake = MISTAKES[name]
        report = judge(CASES[mistake.case], mistake.solver(run.device))
        noticed[name] = report["failures"]
        if not report["failures"]:
            run.failures.append(f"{name}: not noticed by {mistake.case}")
        run.progress(done / len(names))
    return noticed


def section(noticed: dict[str, list[str]], _page: Page) -> str:
    """Return the table of the mistakes."""
    rows = [
        [
            name,
            MISTAKES[name].what,
            f"`{MISTAKES[name].case}`",
            escaped((failures or ["**not noticed**"])[0]),
        ]
        for name, failures in noticed.items()
    ]
    return "\n\n".join(
        [
            "## Deliberate mistakes",
            "Solvers built wrong on purpose, by the arguments of `Solver`, and the fastest case "
            "that notices each, with the first law that fails. The referee of random scenes is "
            "tried with them as well, in `tests/benchmarks/test_random_scenes.py`.",
            table(["mistake", "what is wrong", "noticed by", "law that fails"], rows),
        ]
    )
