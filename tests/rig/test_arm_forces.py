"""Reactions of an arm to the force that its guard sees: one arm for all tests, and a simulated."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.arms import (
    CLOCK,
    CONFIG,
    FRAME,
    LIMITS,
    MOVE_L,
    START,
    STOP_L,
    TCP,
    Client,
    Once,
    at,
    back_at_start,
    emulated,
    height,
    stands_still,
    started,
)
from support.waiting import until

from benchmarks.fake_clock import FakeClock
from rig.core.clock import SECOND_NS
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.guard import ForceGuard
from rig.core.samples import FORCE_LATEST
from rig.core.shared_memory import SharedLatest
from rig.devices.arm.arm import Arm
from rig.devices.arm.emulated_arm import CYCLE
from rig.devices.arm.emulated_controller import Controller
from rig.devices.arm.messages import Move, Setup
from rig.devices.arm.mover import Mover, Watch

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


@pytest.mark.slow
def test_the_soft_limit_ends_a_press_which_can_be_left(feeling, force):
    def press() -> None:
        push(force, 0.9 * 10.0 if height() < 0.02 else 1.0)

    result = feeling.move(at(0, 0, 0), on_wait=press)
    assert result.outcome == "force_limited"
    assert result.reason.startswith("Fz: -9 N (90% of 10 N)")
    assert 0.001 < height() < 0.02
    assert feeling.move(at(0, 0, 0.025), mode="retreat").outcome == "done"


@pytest.mark.slow
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


class Simulated(FakeClock):
    """An arm, its controller and a spring under its tip, on a clock that only waiting moves.

    It is what a mover and its watch ask of the control program and the pose link.
    """

    def __init__(self, stiffness: float, path: Path) -> None:
        super().__init__(SECOND_NS)
        self.controller = Controller(START, TCP)
        self.client = Client(self.controller)
        self.force = SharedLatest.create(path, FORCE_LATEST)
        self.stiffness, self.most = stiffness, 0.0

    def sleep_until(self, deadline_ns: int) -> None:
        while self.now_ns() < deadline_ns:
            self.advance(CYCLE)
            self.controller.cycle()
            load = self.stiffness * max(0.0, FRAME[2] - self.controller.robot.pose[2])
            self.most = max(self.most, load)
            self.force.write((self.now_ns(), 0, (0, 0, -load, 0, 0, 0)))

    def receive(self, timeout: float) -> list[dict[str, Any]]:
        robot = self.controller.robot
        value, speed = tuple(robot.pose), tuple(robot.speed)
        sample = {"value": value, "speed": speed, "speed_fraction": 1.0, "safety_status": 1}
        return [{**sample, "t_ns": self.now_ns()}]

    def connected(self) -> bool:
        return True

    kick = connected

    def reaches(self, pose: list[float]) -> bool:
        return True

    def operation(self) -> tuple[int, bool]:
        number, _, running = self.client.word
        return number, running

    def start_move(self, pose: list[float], speed: float, acceleration: float) -> bool:
        self.client.command(MOVE_L, [*pose, speed, acceleration], 1)
        return True

    def start_stop(self, deceleration: float) -> None:
        self.client.command(STOP_L, [deceleration], 1)


@pytest.mark.parametrize(
    ("soft", "outcome", "limit"), [(0.8, "safety_stop", 0.8), (0.5, "force_limited", 0.5)]
)
def test_a_press_ends_at_its_limit_and_the_force_stays_below_the_rating(
    soft: float, outcome: str, limit: float, tmp_path: Path
) -> None:
    limits = replace(
        LIMITS,
        force_rating=(12.0, 12.0, 0.3, 1.0, 1.0, 1.0),
        **{"soft_fraction": soft, "hard_fraction": 0.8, "horizon": 0.0005},
    )
    path = tmp_path / "force"
    arm: Any = Simulated(500.0, path)
    setup = Setup(CONFIG, FRAME, limits, None, ((path, ForceGuard(limits)),))
    mover = Mover(setup, arm, Watch(setup, arm, arm), arm, lambda: False)
    mover.wait_for_pose(1.0)
    speed, acceleration = 0.01, CONFIG.acceleration
    press = Move(1, tuple(at(0, 0, -0.004)), speed, acceleration, "guarded")
    reply = mover.move(press, lambda seconds: None)
    assert reply.outcome == outcome
    assert reply.reason.startswith("Fz: ")
    # A cycle of the loop, one of the controller, and the way to a stop from 10 mm/s.
    assert limit * 0.3 - 0.01 < arm.most < limit * 0.3 + 0.05
    assert arm.most < 0.3
    arm.force.close()
