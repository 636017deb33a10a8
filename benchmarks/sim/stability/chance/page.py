"""Write docs/results/stability-random.md from the results of the scenes."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Sequence

from benchmarks.sim.stability.chance.referee import LAWS
from benchmarks.sim.stability.chance.run import WRONG, RandomRun, Told, by_class
from benchmarks.sim.stability.chance.shrink import failure
from benchmarks.sim.stability.laws import escaped

_INTRO = """# Stability, random scenes

Randomly drawn scenes: indenters, gels, places, motions and effects, most of them sensible, some
known to break simulators, some absurd. A referee that is independent of the solver checks each
result against laws of mechanics; it reads force, surface and traction, not the solver's metrics.

Repeat it with `make hard-cases RANDOM=300` (`SEED=1` for other scenes; `python -m benchmarks
hard-cases --random 1 --seed 0 --scene 17` for one). It fails on a silently wrong answer, or on a
crash. Laws and limits are explained in `benchmarks/sim/stability/chance/referee.py`.
"""
_MEANS = {
    "right": "all laws hold",
    "refused": "a SceneError names the wrong input and the allowed range",
    "diverged": "SimulationDiverged states the waypoint and the attempts",
    "warned": "laws are broken, and a warning of the result covers them",
    "silent": "laws are broken, without a warning",
    "crash": "any other exception",
    "timeout": "no answer within the time for one solve",
}


def page(told: Sequence[Told], plan: RandomRun) -> str:
    """Return the page as Markdown."""
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
    lines += [
        "| law | statement | measured | broken | of these, without warning |",
        "|---|---|---|---|---|",
    ]
    lines += _by_law(told)
    lines += ["", "## By family", "", "| family | " + " | ".join(by_class(told)) + " |"]
    lines += ["|---" * (len(by_class(told)) + 1) + "|", *_by_family(told)]
    wrong = [one for one in told if one.verdict.kind in WRONG or one.verdict.kind == "timeout"]
    if wrong:
        lines += ["", "## Silently wrong, crashed, or without an answer in time", ""]
        lines += ["| seed/scene | class | scene | laws or message | s |", "|---|---|---|---|---|"]
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
        return "All numbers are finite."
    if name == "symmetric":
        return "A mirror-symmetric scene has mirror-symmetric forces."
    return "The twin scene has the same forces."


def _by_family(told: Sequence[Told]) -> list[str]:
    rows = []
    for family in sorted({one.what.split(", ")[0] for one in told}):
        some = [one for one in told if one.what.split(", ")[0] == family]
        rows.append(f"| {family} | " + " | ".join(map(str, by_class(some).values())) + " |")
    return rows
