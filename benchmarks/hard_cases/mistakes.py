"""Part `mistakes`: solvers built wrong on purpose, each of which a case must notice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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
    """A wrong solver, and the fastest case that notices it."""

    what: str
    case: str
    solver: Solver


def _wrong(what: str, case: str, **arguments: Any) -> Mistake:
    return Mistake(what, case, Solver(**arguments))


def _unsettled(what: str, case: str, **settings: Any) -> Mistake:
    return Mistake(what, case, Solver(settings=settings))


PUNCH, RELOAD, SAG = "flat-punch-between-bounds", "reload-after-unload", "sags-under-gravity"
TIGHT = "tighter-tolerance"
MISTAKES = {
    "force-scaled": _wrong("forces of 1.1 times the right ones", PUNCH, answers=_scaled),
    "locking": _wrong(
        "forces of elements that lock near nu = 0.5", "poisson-0-49", answers=_locking
    ),
    "pushes-outwards": _wrong("the force along x has the other sign", "rim-10-mm", answers=_aside),
    "frames-skipped": _wrong("each second frame repeats the one before", RELOAD, answers=_skipping),
    "poisson-0-3": _wrong("every gel has Poisson's ratio 0.3", SAG, solves=_compressible),
    "friction-ignored": _wrong(
        "no friction", "full-stick-stiffens", solves=_effects(friction=None)
    ),
    "friction-doubled": _wrong(
        "twice the coefficient of friction", "shear-friction-0-3", solves=_rougher
    ),
    "viscosity-ignored": _wrong(
        "no viscosity", "fast-and-slow-presses", solves=_effects(viscosity=None)
    ),
    "inertia-ignored": _wrong("no inertia", "fast-press-with-mass", solves=_effects(inertia=None)),
    "gravity-upwards": _wrong("gravity with the other sign", SAG, solves=_upside_down),
    "loose-tolerance": _unsettled(
        "a tenth of the force may be out of balance", TIGHT, tolerance=0.1
    ),
    "soft-contact": _unsettled(
        "contact a 25th as stiff, without updates of its multipliers",
        PUNCH,
        penalty=8.0,
        augmentations=0,
    ),
    "float32-only": _unsettled("never more digits than float32", TIGHT, precision="float32"),
}
# Those of a quick run.
QUICK = ("force-scaled", "gravity-upwards", "loose-tolerance")


def measure(run: Run) -> dict[str, Any]:
    """Judge each wrong solver by the case that must notice it."""
    names = QUICK if run.quick else tuple(MISTAKES)
    noticed = {}
    for done, name in enumerate(names, start=1):
        mistake = MISTAKES[name]
        report = judge(CASES[mistake.case], replace(mistake.solver, device=run.device))
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
