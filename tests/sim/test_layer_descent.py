"""Projected gradient descent at the limit of floating-point precision."""

from __future__ import annotations

import numpy as np

from sim.layer.contact import Problem, descend

COMPLIANCE = np.array([1e-4, 2e-4, 5e-4], np.float32)


def solved(load: float) -> np.ndarray:
    problem = Problem(
        apply=lambda x: COMPLIANCE * x, project=lambda x: np.maximum(x, 0), local=2e-4
    )
    slope = np.full(3, -load, np.float32)
    found = descend(problem, np.zeros(3, np.float32), slope, tolerance=1e-5, iterations=50)
    return found.x


def test_loads_find_their_answer() -> None:
    np.testing.assert_allclose(solved(1.0), 1 / COMPLIANCE, rtol=1e-4)


def test_loads_whose_squares_vanish_end_without_a_division_by_nothing() -> None:
    for exponent in range(-18, -30, -1):
        assert (solved(10.0**exponent) >= 0).all()
