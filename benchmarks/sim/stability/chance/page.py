"""docs/results/stability-random.md, from what came of the scenes."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Sequence

from benchmarks.sim.stability.chance.referee import LAWS
from benchmarks.sim.stability.chance.run import WRONG, Plan, Told, by_class
from benchmarks.sim.stability.chance.shrink import failure
from benchmarks.sim.stability.laws import escaped

_INTRO = """# Stability, scenes drawn by chance

Scenes that nobody chose: indenters, gels, places, motions and effects drawn by chance, most of them
sensible, some known to break simulators, some absurd. A referee that is not the solver holds each
result to laws of mechanics; it reads force, surface and traction, never the solver's own figures.

Repeat it with `make hard-cases RANDOM=300` (`SEED=1` for others; `python -m benchmarks hard-cases
--random 1 --seed 0 --scene 17` for one). It fails when an answer is silently wrong, or on a crash.
Laws and limits are explained where they stand, in `benchmarks/sim/stability/chance/referee.py`.
"""
_MEANS = {
    "right": "all laws hold",
    "refused": "a SceneError names what is wrong and what is allowed",
    "diverged": "SimulationDiverged says where and what was tried",
    "warned": "laws are broken, and a warning of the result owns up to them",
    "silent": "laws are broken, and nothing says so",
    "crash": "any other exception",
    "timeout": "no answer within the time for one solve",
}


def page(told: Sequence[Told], plan: Plan) -> str:
    """The page as Markdown."""
    passed = sum(one.verdict.passed for one in told)
    seconds = sum(one.seconds for one in told)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, device {plan.settings.device}"
    lines = [
        _INTRO,
        f"Seed {plan.seed}, scenes {plan.first} to {plan.first + plan.count - 1}, precision "
        f"{plan.settings.precision}, up to {plan.settings.seconds:g} s a solve: {len(told)} cases, "
        f"{passed} passed; {seconds / 60:.1f} minutes of one process ({machine}).",
        "", "## By class", "", "| class | means | scenes |", "|---|---|---|",
    ]  # fmt: skip
    lines += [f"| {kind} | {_MEANS[kind]} | {count} |" for kind, count in by_class(told).items()]
    lines += ["", "## By law", ""]
    lines += ["| law | says | measured | broken | of these, silently |", "|---|---|---|---|---|"]
    lines += _by_law(told)
    lines += ["", "## By family", "", "| family | " + " | ".join(by_class(told)) + " |"]
    lines += ["|---" * (len(by_class(told)) + 1) + "|", *_by_family(told)]
    wrong = [one for one in told if one.verdict.kind in WRONG or one.verdict.kind == "timeout"]
    if wrong:
        lines += ["", "## Silently wrong, crashed, or without an answer in time", ""]
        lines += ["| seed/scene | class | what | laws or words | s |", "|---|---|---|---|---|"]
        lines += [
            f"| {one.name} | {one.verdict.kind} | {escaped(one.what)} | "
            f"{escaped(one.verdict.why)} | {one.seconds:.1f} |"
            for one in wrong
        ]
    return "\n".join(lines) + "\n"


def _by_law(told: Sequence[Told]) -> list[str]:
    measured = Counter(name for one in told for name in one.verdict.laws)
    broken = Counter(name for one in told for name in {each.name for each in one.verdict.broken})
    silent = Counter(name for one in told for name in failure(one.verdict))
    rows = []
    for name in sorted(measured, key=lambda name: (-silent[name], -broken[name], name)):
        says = (LAWS[name].__doc__ or "").split("\n\n")[0] if name in LAWS else _said(name)
        rows.append(
            f"| {name} | {escaped(' '.join(says.split()))} | {measured[name]} | {broken[name]} | "
            f"{silent[name]} |"
        )
    return rows


def _said(name: str) -> str:
    if name == "finite":
        return "No number is infinite or none."
    if name == "symmetric":
        return "Forces of a scene that is its own mirror image are their own image."
    return "The twin scene has the same forces."


def _by_family(told: Sequence[Told]) -> list[str]:
    rows = []
    for family in sorted({one.what.split(", ")[0] for one in told}):
        some = [one for one in told if one.what.split(", ")[0] == family]
        rows.append(f"| {family} | " + " | ".join(map(str, by_class(some).values())) + " |")
    return rows
