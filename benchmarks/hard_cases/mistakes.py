"""Part `mistakes`: solvers built wrong on purpose, each of which a case must notice."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from benchmarks.hard_cases.named_cases import escaped, judge
from benchmarks.hard_cases.solver import Solver
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from sim.effect_sizes import weakened
from sim.result import Result
from sim.scene import Scene


def _times(factor: float, name: str) -> Callable[[Scene], Scene]:
    """Return a function that scales an effect of a scene; by 0 there is none."""

    def changed(scene: Scene) -> Scene:
        effect = getattr(scene.effects, name)
        scaled = weakened(effect, factor) if effect and factor else None
        return replace(scene, effects=replace(scene.effects, **{name: scaled}))

    return changed


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
    names = ("wrench", "surface", "traction")
    return replace(result, **{name: getattr(result, name)[frames] for name in names})


class Mistake(NamedTuple):
    """A wrong solver, and the fastest case that notices it."""

    what: str
    case: str
    solver: Solver


def _wrong(what: str, case: str, **arguments: Any) -> Mistake:
    return Mistake(what, case, Solver(**arguments))


PUNCH, SAG, TIGHT = "flat-punch-between-bounds", "sags-under-gravity", "tighter-tolerance"
STICK, RUB, RELOAD = "full-stick-stiffens", "shear-friction-0-3", "reload-after-unload"
SPEEDS, FAST = "fast-and-slow-presses", "fast-press-with-mass"
LOOSE, SOFT = {"tolerance": 0.1}, {"penalty": 8.0, "augmentations": 0}
MISTAKES = {
    "force-scaled": _wrong("forces of 1.1 times the right ones", PUNCH, answers=_scaled),
    "locking": _wrong(
        "forces of elements that lock near nu = 0.5", "poisson-0-49", answers=_locking
    ),
    "pushes-outwards": _wrong("the force along x has the other sign", "rim-10-mm", answers=_aside),
    "frames-skipped": _wrong("each second frame repeats the one before", RELOAD, answers=_skipping),
    "poisson-0-3": _wrong("every gel has Poisson's ratio 0.3", SAG, solves=_compressible),
    "friction-ignored": _wrong("no friction", STICK, solves=_times(0, "friction")),
    "friction-doubled": _wrong(
        "twice the coefficient of friction", RUB, solves=_times(2, "friction")
    ),
    "viscosity-ignored": _wrong("no viscosity", SPEEDS, solves=_times(0, "viscosity")),
    "inertia-ignored": _wrong("no inertia", FAST, solves=_times(0, "inertia")),
    "gravity-upwards": _wrong("gravity with the other sign", SAG, solves=_times(-1, "gravity")),
    "loose-tolerance": _wrong("a tenth of the force may be out of balance", TIGHT, settings=LOOSE),
    "soft-contact": _wrong(
        "contact a 25th as stiff, without updates of its multipliers", PUNCH, settings=SOFT
    ),
    "float32-only": _wrong(
        "never more digits than float32", TIGHT, settings={"precision": "float32"}
    ),
}
# Those of a quick run.
QUICK = ("force-scaled", "gravity-upwards", "loose-tolerance")


def measure(run: Run) -> dict[str, list[str]]:
    """Judge each wrong solver by the case that must notice it."""
    names = QUICK if run.quick else tuple(MISTAKES)
    noticed = rows_of(run, partial(_failures, run.device), {name: name for name in names})
    missed = [name for name, failures in noticed.items() if not failures]
    run.failures += [f"{name}: not noticed by {MISTAKES[name].case}" for name in missed]
    return noticed


def _failures(device: str, name: str) -> list[str]:
    _, case, solver = MISTAKES[name]
    return list(judge(replace(solver, device=device), case)["failures"])


def section(noticed: dict[str, list[str]], _page: Page) -> str:
    """Return the table of the mistakes."""
    rows = []
    for name, failures in noticed.items():
        what, case, _ = MISTAKES[name]
        rows.append([name, what, f"`{case}`", escaped((failures or ["**not noticed**"])[0])])
    text = (
        "## Deliberate mistakes\n\nSolvers built wrong on purpose, by the arguments of `Solver`, "
        "and the fastest case that notices each, with the first law that fails. The laws of "
        "random scenes are tried with them as well, in `tests/benchmarks/test_random_scenes.py`."
    )
    return f"{text}\n\n{table(['mistake', 'what is wrong', 'noticed by', 'law that fails'], rows)}"
