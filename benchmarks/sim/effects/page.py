"""Page `docs/results/effects.md`."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Sequence

import warp as wp

from benchmarks.sim.effects.measure import PARTS, Combination, Cost
from benchmarks.sim.effects.scenes import TRIALS
from benchmarks.sim.effects.without import EFFECTS

_PREFACE = """# Cost of effects

Made by `python -m benchmarks effects`; run it on another machine to get that machine's numbers.
{machine}.

Friction, viscosity, inertia and gravity are one file each in `sim/effects`. Each declares the state
that the `fem` tier stores for it (`STATE`), the kernels that contain its lines (`KERNELS`), and its
limit as it gets weaker (`LIMIT`). Its lines in a kernel are blocks `if wp.static(...):`, which are
not compiled when it is off.

## Off

The claim is that an effect which is off costs nothing. It is tested against a build without the
effect: the blocks are cut out of the kernels' source, and the rest is compiled.
"""

_OFF = """
*Same machine code*: the instructions of every kernel that contains the effect, compiled with the
effect off, and compiled from the source without it. *Same results*: force, surface, traction and
quality of a press with the three other effects on, bit for bit. *Time*: CPU time of a press without
effects, this build over the one without the effect, minimum of {repeats} pairs; deviations from 1
are due to timing noise of the machine.

## On

One press into {elements} elements in double precision; the viscosity has two branches. *Time* is
that of the press with the effect over that without, minimum of {repeats}: more steps where friction
or relaxation need them, more iterations, and the arithmetic itself.
"""

_LIMIT = """
## Limit of weak effects

Change of the force on the last frame, over the force, when the effect is weak: half the parameter
gives half the change and a tenth gives a tenth, so it vanishes with the parameter. Solved to a
residual of 1e-10.
"""

_KERNELS = """
## Kernels

Kernels that a press launches, for every set of effects; those that a press without effects does not
launch; and the CPU time to compile them all. Each is compiled once per machine and kept in Warp's
cache; sets share kernels where possible.
"""


def render(costs: Sequence[Cost], combinations: Sequence[Combination], repeats: int) -> str:
    """Return the page as Markdown."""
    elements = f"{12 * 12 * 4:,}"
    machine = (
        f"Warp {wp.config.version}, Python {platform.python_version()}, "
        f"{platform.machine()}, one CPU core"
    )
    parts = (
            _PREFACE.format(machine=machine),
            _table(
                ("effect", "kernels that contain it", "same machine code", "same results",
                 "numbers of state", "time"),
                (_off(cost) for cost in costs),
            ),
            _OFF.format(repeats=repeats, elements=elements),
            _table(
                ("effect", "state", "numbers", "KiB", "time"),
                (_on(cost) for cost in costs),
            ),
            _LIMIT,
            _table(
                ("effect", "full strength", "weak: share of it",
                 *(f"change at {part:g} x weak" for part in PARTS)),
                (_limit(cost) for cost in costs),
            ),
            _KERNELS,
            _table(
                ("effects", "kernels", "own", "compile [s]"),
                (_combination(one) for one in combinations),
            ),
    )  # fmt: skip
    return "\n".join(parts) + "\n"


def _off(cost: Cost) -> tuple[str, ...]:
    snippets = EFFECTS[cost.name].KERNELS
    places = ", ".join(f"`{one.module}.{one.factory}`" for one in snippets)
    return (
        cost.name,
        places,
        _yes(cost.same_code),
        _yes(cost.same_results),
        str(cost.numbers_off),
        f"{cost.off_ratio:.3f}",
    )


def _on(cost: Cost) -> tuple[str, ...]:
    state = "; ".join(
        f"`{memory.name.rpartition('.')[2].lstrip('_')}` {memory.numbers} per {memory.per}"
        for memory, _numbers in cost.memories
    )
    size = f"{cost.numbers_on * 8 / 1024:,.1f}"
    return cost.name, state, f"{cost.numbers_on:,}", size, f"{cost.on_ratio:.2f}"


def _limit(cost: Cost) -> tuple[str, ...]:
    trial = TRIALS[cost.name]
    changes = (f"{change:.3e}" for change in cost.limits)
    limit = EFFECTS[cost.name].LIMIT
    return f"{cost.name} ({limit})", trial.parameter, f"{trial.share:g}", *changes


def _combination(one: Combination) -> tuple[str, ...]:
    name = ", ".join(one.key) or "none"
    return name, str(one.kernels), str(one.own), f"{one.compile_seconds:.1f}"


def _yes(value: bool) -> str:
    return "yes" if value else "**no**"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])
