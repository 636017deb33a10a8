"""Grip by force: closing, regrip, limits, and every fault ends held."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from rig.acquire.grip_force import ForceGrip, GripSettings, Senses, State
from rig.core.finger import FingerForce
from rig.devices.gripper.robotiq_wire import (
    ACTIVATING,
    ACTIVE,
    AT_POSITION,
    STOPPED_CLOSING,
    GripperCommand,
    GripperStatus,
)

CYCLE_NS = 10_000_000
# Count at which the fingers of the stand-in meet the object; force of a count [N].
MEETS, PER_COUNT = 120, 0.5


class Hand:
    """A gripper that is where it was sent, and two springs with friction between its fingers."""

    def __init__(self, weight: float = 1.0, friction: float = 0.5, **settings: float) -> None:
        self.grip = ForceGrip(GripSettings(**settings))  # type: ignore[arg-type]
        self.position, self.t_ns, self.raised = MEETS - 3, 0, 0.0
        self.weight, self.friction = weight, friction
        self.slid = 0
        self.commands: list[GripperCommand] = []

    @property
    def normal(self) -> float:
        return max(self.position - MEETS, 0) * PER_COUNT

    def senses(self) -> Senses:
        load = min(self.raised, 1.0) * self.weight / 2
        slips = load > self.friction * self.normal
        self.slid += slips
        shear = min(load, self.friction * self.normal)
        left, right = (
            FingerForce(name, self.t_ns, (0.0, shear, -self.normal), (0.1,) * 3, False, slips)
            for name in ("left", "right")
        )
        status = GripperStatus(True, True, ACTIVE, AT_POSITION, 0, self.position, self.position, 0)
        return Senses(self.t_ns, left, right, status, self.t_ns, self.raised > 0)

    def cycle(self, change: Callable[[Senses], Senses] = lambda senses: senses) -> None:
        self.t_ns += CYCLE_NS
        command = self.grip.step(change(self.senses()))
        if command is not None:
            self.commands.append(command)
            self.position = command.position
        if self.grip.firm:
            self.raised = min(self.raised + 0.05, 1.0)

    def run(self, cycles: int, change: Callable[[Senses], Senses] = lambda senses: senses) -> None:
        for _ in range(cycles):
            self.cycle(change)


def lifted(**settings: float) -> Hand:
    hand = Hand(**settings)
    hand.run(200)
    assert hand.raised == 1.0
    assert hand.grip.state == State.HOLDING
    return hand


@pytest.mark.parametrize("friction", [0.25, 0.5, 0.75])
def test_the_grip_becomes_as_tight_as_weight_and_friction_need(friction: float) -> None:
    hand = lifted(friction=friction)
    least = hand.weight / 2 / friction
    assert least <= hand.normal <= 1.3 * least + PER_COUNT


def test_a_slip_shows_the_friction() -> None:
    hand = lifted(weight=1.5, friction=0.3)
    assert hand.slid > 0
    assert hand.grip.friction == pytest.approx(0.3, rel=0.01)


def test_a_load_that_friction_forbids_is_refused_and_let_go_once_it_stands() -> None:
    hand = Hand(weight=8.0, friction=0.5)
    hand.run(300)
    assert hand.grip.state == State.REFUSED
    assert "5 counts from touch" in hand.grip.reason
    assert hand.raised < 1.0
    assert hand.position <= MEETS + 1 + 5
    hand.run(20, lambda senses: replace(senses, release=True, aloft=True))
    assert hand.position > MEETS
    hand.run(1, lambda senses: replace(senses, release=True, aloft=False))
    assert (hand.grip.state, hand.position) == (State.OPENED, 0)


def test_excess_is_eased_but_never_past_the_touch() -> None:
    hand = lifted()
    before = hand.position

    def pressed(senses: Senses) -> Senses:
        assert senses.left is not None
        assert senses.right is not None
        force = (0.0, 0.4, -12.0)
        left, right = replace(senses.left, force=force), replace(senses.right, force=force)
        return replace(senses, left=left, right=right)

    hand.run(100, pressed)
    assert MEETS + 1 == hand.position < before
    assert hand.grip.state == State.HOLDING


def changed(finger: str, **values: object) -> Callable[[Senses], Senses]:
    def change(senses: Senses) -> Senses:
        return replace(senses, **{finger: replace(getattr(senses, finger), **values)})  # type: ignore[arg-type]

    return change


def status(**values: object) -> Callable[[Senses], Senses]:
    return lambda senses: replace(senses, status=replace(senses.status, **values))  # type: ignore[type-var]


FAULTS: dict[str, Callable[[Senses], Senses]] = {
    "left finger: its force is 101 ms old": lambda senses: changed(
        "left", t_ns=senses.t_ns - 101_000_000
    )(senses),
    "right finger: no force yet": lambda senses: replace(senses, right=None),
    "left finger: its force or interval is": changed("left", force=(0.0, math.nan, -1.0)),
    "right finger: its force or interval is": changed("right", half_width=(math.nan,) * 3),
    "right finger: its frame is unlike": changed("right", outside=True),
    "the fingers' normal forces differ by": changed("left", force=(0.0, 0.5, -9.0)),
    "the gripper does not answer": lambda senses: replace(senses, status_ns=senses.t_ns - 10**9),
    "no status of the gripper yet": lambda senses: replace(senses, status=None),
    "gripper: fault 8: too hot": status(fault=8),
    "the gripper is not active": status(state=ACTIVATING),
    "by 20 N": status(object=STOPPED_CLOSING, requested=255),
}


@pytest.mark.parametrize("aloft", [True, False])
@pytest.mark.parametrize("reason", FAULTS)
def test_every_fault_ends_held(reason: str, aloft: bool) -> None:
    hand = lifted()
    hand.raised = float(aloft)
    held = hand.position
    hand.run(100, FAULTS[reason])
    assert (hand.grip.state, hand.position) == (State.GIVEN_UP, held)
    assert reason in hand.grip.reason
    hand.run(100)  # good forces again: a person has to look first
    assert (hand.grip.state, hand.position) == (State.GIVEN_UP, held)


@pytest.mark.parametrize("reason", FAULTS)
def test_a_short_fault_of_forces_only_pauses(reason: str) -> None:
    hand = Hand()
    hand.run(8)
    held = hand.position
    hand.run(3, FAULTS[reason])
    assert hand.position == held
    assert reason in hand.grip.reason
    hand.run(200)
    ends = reason.startswith(("the gripper", "gripper:", "by 20 N"))
    assert hand.grip.state == (State.GIVEN_UP if ends else State.HOLDING)


def test_a_lost_object_is_noticed_and_nothing_moves() -> None:
    hand = lifted()
    held = hand.position
    gone = (0.0, 0.0, 0.0)
    hand.run(50, lambda one: changed("left", force=gone)(changed("right", force=gone)(one)))
    assert (hand.grip.state, hand.position) == (State.LOST, held)


def test_nothing_between_the_fingers_ends_without_a_grip() -> None:
    hand = Hand()
    hand.position = 225
    gone = (0.0, 0.0, 0.0)
    hand.run(50, lambda one: changed("left", force=gone)(changed("right", force=gone)(one)))
    assert (hand.grip.state, hand.grip.reason) == (State.LOST, "closed on nothing")


def test_a_pedal_that_is_not_held_keeps_everything_where_it_is() -> None:
    hand = Hand()
    hand.run(50, lambda senses: replace(senses, allowed=False, release=True))
    assert hand.commands == []
    hand.run(200)
    assert hand.grip.state == State.HOLDING


def test_no_count_follows_another_before_both_fingers_have_felt_it() -> None:
    hand = Hand()
    hand.cycle()
    old_ns = hand.t_ns
    both = changed("left", t_ns=old_ns)
    hand.run(8, lambda senses: both(senses))
    assert len(hand.commands) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [("limit", 21.0), ("limit", 0.1), ("margin", 0.9), ("stale", 0.0), ("travel", 0)],
)
def test_settings_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name}: found"):
        GripSettings(**{name: value})  # type: ignore[arg-type]
