"""Hard cases, by family: a table in each family's file, in the order of the page."""

from __future__ import annotations

from fnmatch import fnmatch

from benchmarks.hard_cases.cases import (
    edges,
    friction,
    in_time,
    precision,
    pressing,
    steps,
    wrong_input,
)
from benchmarks.hard_cases.solver import Case

FAMILIES = (pressing, edges, friction, steps, precision, in_time, wrong_input)
BY_FAMILY = {(family.__doc__ or "").split(":")[0]: family.CASES for family in FAMILIES}
CASES: dict[str, Case] = {
    name: case for cases in BY_FAMILY.values() for name, case in cases.items()
}
# The longest, which start first, so that none is left alone at the end.
LONGEST = ("named-indenters", "tube-off-the-grid", "shear-in-few-or-many-frames")
# At least one of each family, all together some seconds.
QUICK = (
    "poisson-0-3",
    "flat-punch-between-bounds",
    "lifted-while-it-slips",
    "never-touches",
    "starts-at-touch",
    "metres-and-millimetres",
    "mirror-symmetry",
    "inertia-of-no-mass",
    "millimetres-for-metres",
    "one-newton-iteration",
    "phases-without-time",
)


def asserts(case: Case) -> str:
    """Return the assertion of a case, in one sentence."""
    return (case.__doc__ or "").strip().split("\n\n")[0].replace("\n    ", " ")


def chosen(patterns: list[str]) -> list[str]:
    """Return the names that match any pattern (with `*` and `?`), or all without patterns.

    Raises:
        ValueError: A pattern that matches nothing.
    """
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in CASES):
            raise ValueError(f"no case is called {pattern!r}; allowed: {', '.join(CASES)}")
    return [name for name in CASES if any(fnmatch(name, each) for each in patterns or ["*"])]
