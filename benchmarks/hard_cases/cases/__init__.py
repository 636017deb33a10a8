"""All hard cases, in the order of the table."""

from __future__ import annotations

from fnmatch import fnmatch

from benchmarks.hard_cases.case import Case
from benchmarks.hard_cases.cases import (
    depth,
    edges,
    friction,
    in_time,
    material,
    precision,
    rim,
    steps,
    wrong_input,
)

FAMILIES = (material, depth, edges, rim, friction, steps, precision, in_time, wrong_input)
CASES: tuple[Case, ...] = tuple(case for family in FAMILIES for case in family.CASES)
BY_NAME = {case.name: case for case in CASES}


def chosen(patterns: list[str]) -> tuple[Case, ...]:
    """Return cases whose name matches any pattern (with `*` and `?`), or all without patterns.

    Raises:
        ValueError: A pattern that matches nothing.
    """
    for pattern in patterns:
        if not any(fnmatch(case.name, pattern) for case in CASES):
            raise ValueError(f"no case is called {pattern!r}; --list shows them")
    return tuple(
        case
        for case in CASES
        if not patterns or any(fnmatch(case.name, pattern) for pattern in patterns)
    )
