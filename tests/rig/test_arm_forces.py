"""Reactions of an arm to the force that its guard sees; all tests here share one arm."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.arms import (
    CLOCK,
    CONFIG,
    LIMITS,
    Once,
    at,
    back_at_start,
    emulated,
    height,
    stands_still,
    started,
)
from support.waiting import until

from rig.core.clock import SECOND_NS
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.guard import ForceGuard
from rig.core.samples import FORCE_LATEST
from rig.core.shared_memory import SharedLatest
from rig.devices.arm.arm import Arm

pytest.importorskip("rtde_control", reason="ur-rtde is not installed: pip install -e '.[rig]'")


def push(record: SharedLatest, load: float, *, status: int = 0, age: float = 0.0) -> None:
    record.write((CLOCK.now_ns() - round(age * SECOND_NS), status, (0, 0, -load, 0, 0, 0)))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("arm") / "force"


@pytest.fixture(scope="module")
def force(path: Path) -> Iterator[SharedLatest]:
    record = SharedLatest.create(path, FORCE_LATEST)
    push(record, 0.0)
    yield record
    record.close()


@pytest.fixture(scope="module")
def shared(force: SharedLatest, path: Path) -> Iterator[Arm]:
    """An arm with an F/T sensor whose force the tests set."""
    with emulated(), started(guards={path: ForceGuard(LIMITS)}) as arm:
        yield arm


@pytest.fixture
def feeling(shared: Arm, force: SharedLatest) -> Arm:
    push(force, 0.0)
    back_at_start(shared)
    # The previous test may have left a message of its guard.
    with contextlib.suppress(DeviceLost, SafetyStop):
        shared.check()
    return shared


def test_the_soft_limit_ends_a_press_which_can_be_left(feeling, force):
    def press() -> None:
        push(force, 0.9 * 10.0 if height() < 0.02 else 1.0)

    result = feeling.move(at(0, 0, 0), on_wait=press)
    assert result.outcome == "force_limited"
    assert result.reason.startswith("Fz: -9 N (90% of 10 N)")
    assert 0.001 < height() < 0.02
    assert feeling.move(at(0, 0, 0.025), mode="retreat").outcome == "done"


def test_the_hard_limit_is_a_safety_stop_that_can_be_retracted_from(feeling, force):
    with pytest.raises(SafetyStop, match="hard limit"):
        feeling.move(at(0, 0, 0), on_wait=lambda: push(force, 11.0 if height() < 0.02 else 1.0))
    assert stands_still()
    before = height()
    assert feeling.retract()
    assert height() == pytest.approx(before + CONFIG.retract, abs=1e-4)


def test_a_force_that_falls_silent_stops_the_arm_and_says_what_to_check(feeling, force):
    slow = {"speed": 0.005, "acceleration": 0.1}
    with pytest.raises(DeviceLost, match=r"force is .* old.*F/T sensor"):
        feeling.move(at(0, 0, 0), **slow, on_wait=Once(lambda: push(force, 0.0, age=3.0)))
    assert stands_still()
    assert 0.001 < height() < 0.03
    assert feeling.alive
    assert feeling.retract()


def test_a_load_that_comes_while_the_arm_rests_is_told_by_check(feeling, force):
    push(force, 0.0)
    assert feeling.move(at(0, 0, 0.029)).outcome == "done"
    feeling.check()
    push(force, 12.0)

    def alarmed() -> bool:
        try:
            feeling.check()
        except SafetyStop as error:
            return "hard limit" in str(error)
        return False

    until(alarmed)
