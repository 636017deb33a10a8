"""Parameters of tests that repeat a behaviour: a few by default, all with the slow tests."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest


def few(values: Iterable[Any], count: int) -> list[Any]:
    """Return all values for `parametrize`, all but `count` of them marked slow.

    The others are spread evenly, from the first to the last. For tests with several parameters,
    each value is a `pytest.param`.
    """
    given = list(values)
    if not 0 < count < len(given):
        raise ValueError(f"count: {count}; allowed: 1 to {len(given) - 1}")
    kept = set(np.linspace(0, len(given) - 1, count).round().astype(int).tolist())
    found = []
    for number, value in enumerate(given):
        one = value if hasattr(value, "marks") else pytest.param(value)
        slow = () if number in kept else (pytest.mark.slow,)
        found.append(pytest.param(*one.values, marks=(*one.marks, *slow), id=one.id))
    return found
