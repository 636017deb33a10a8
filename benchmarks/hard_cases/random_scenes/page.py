"""Write docs/results/stability-random.md from the results of the scenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.hard_cases.laws import escaped
from benchmarks.hard_cases.random_scenes.referee import LAWS
from benchmarks.hard_cases.random_scenes.run import WRONG, RandomRun, Told, by_class
from benchmarks.hard_cases.random_scenes.shrink import failure
from recorder.pages import render


def page(told: Sequence[Told], plan: RandomRun) -> str:
    """Return the page as Markdown."""
    measured = Counter(name for one in told for name in one.outcome.laws)
    broken = Counter(name for one in told for name in {each.name for each in one.outcome.broken})
    silent = Counter(name for one in told for name in failure(one.outcome))
    names = sorted(measured, key=lambda name: (-silent[name], -broken[name], name))
    families: dict[str, list[Told]] = {}
    for one in sorted(told, key=_family):
        families.setdefault(_family(one), []).append(one)
    return render(
        Path(__file__).with_suffix(".md"),
        told=told,
        plan=plan,
        by_class=by_class,
        laws=[(name, measured[name], broken[name], silent[name]) for name in names],
        statement=_statement,
        families=families,
        wrong=[one for one in told if one.outcome.kind in (*WRONG, "timeout")],
        escaped=escaped,
    )


def _family(one: Told) -> str:
    return one.what.split(", ")[0]


def _statement(law: str) -> str:
    if law in LAWS:
        return " ".join((LAWS[law].__doc__ or "").split("\n\n")[0].split())
    if law == "finite":
        return "All numbers are finite."
    if law == "symmetric":
        return "A mirror-symmetric scene has mirror-symmetric forces."
    return "The twin scene has the same forces."
