"""Resuming starts at the first target that is not done, regardless of earlier events."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recorder import OUTCOMES
from rig.acquire.collector import CollectRequest
from rig.acquire.completed import first_open_target
from trajectories import PressShear

PLAN = PressShear(3e-3, 4e-3, 0.3e-3, 1.2e-3, math.radians(30), 1e-3, points=(1,))
COMPLETE, LIMITED, INTERRUPTED, STOPPED = (
    OUTCOMES.index(name) for name in ("complete", "force_limited", "interrupted", "stopped")
)
Row = tuple[int, int, int, int]


def table(rows: list[Row]) -> dict[str, np.ndarray]:
    columns = np.array(rows, dtype=int).reshape(-1, 4).T
    return dict(zip(("target", "phase", "outcome", "run"), columns, strict=True))


def whole(target: int, run: int = 0) -> list[Row]:
    return [(target, phase, COMPLETE, run) for phase in range(4)]


@given(st.integers(0, 48))
def test_it_goes_on_after_the_targets_that_are_complete(done: int) -> None:
    rows = [row for target in range(done) for row in whole(target)]
    assert first_open_target(PLAN, table(rows), 48) == done


@given(st.integers(0, 47), st.integers(0, 3), st.sampled_from((INTERRUPTED, STOPPED)))
def test_a_target_that_broke_off_is_pressed_again(target: int, phase: int, outcome: int) -> None:
    rows = [row for before in range(target) for row in whole(before)]
    rows += [(target, before, COMPLETE, 0) for before in range(phase)]
    rows += [(target, phase, outcome, 0)]
    assert first_open_target(PLAN, table(rows), 48) == target


def test_two_halves_of_two_runs_make_no_whole_target() -> None:
    halves = [(0, 0, COMPLETE, 0), (0, 1, COMPLETE, 0), (0, 2, COMPLETE, 1), (0, 3, COMPLETE, 1)]
    assert first_open_target(PLAN, table(halves), 48) == 0
    assert first_open_target(PLAN, table(halves + whole(0, run=2)), 48) == 1


def test_a_target_interrupted_and_pressed_again_in_the_same_run_is_done() -> None:
    broken = [(0, 0, COMPLETE, 0), (0, 1, INTERRUPTED, 0)]
    assert first_open_target(PLAN, table(broken), 48) == 0
    assert first_open_target(PLAN, table(broken + whole(0)), 48) == 1
    assert first_open_target(PLAN, table(broken + broken + whole(0)), 48) == 1
    # Two broken attempts in one run make no whole target.
    first, rest = whole(0)[:2], whole(0)[2:]
    assert first_open_target(PLAN, table([*first, (0, 2, INTERRUPTED, 0), *rest]), 48) == 0
    assert first_open_target(PLAN, table([*first, *first, rest[0]]), 48) == 0


def test_a_force_limited_target_is_done() -> None:
    rows = [(0, 0, LIMITED, 0), *whole(1)]
    assert first_open_target(PLAN, table(rows), 48) == 2


def test_only_the_wanted_targets_count() -> None:
    rows = [row for target in range(8) for row in whole(target)]
    assert first_open_target(PLAN, table(rows), 8) == 8


def test_targets_are_pressed_again_in_order_before_those_that_are_open() -> None:
    request = CollectRequest(Path("s.zarr"), PLAN, 12, resume=True, again=(5, 2, 9))
    found = request.to_press(8)
    assert [target.index for target in found] == [2, 5, 8, 9, 10, 11]
