"""Simulated grips by force: objects, lifts by the truth, how slips are counted, and the command."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.commands import run_module

import tactile.grip
from rig.acquire.grip_force import GripSettings, State
from rig.bench.pair import GraspObject, PairSpec
from rig.mock.world.pair import GRAVITY, PairWorld
from tactile.grasp_demo import (
    COUNT,
    LATENCY_NS,
    SKIN,
    Lift,
    Load,
    Now,
    counted,
    drawn_loads,
    lift,
    ratio,
    truth,
)
from tactile.grasp_model import LENGTH, SENSOR, SimulatedPresses

GRIP = GripSettings()


@pytest.fixture(scope="module")
def world() -> PairWorld:
    return PairWorld(PairSpec(SENSOR, SENSOR))


def load_of(mass: float, friction: float) -> Load:
    one = GraspObject("one", ("cylinder", "cylinder"), 0.03, mass, friction / SKIN)
    return Load(one, mass * GRAVITY / 2 / friction, math.inf, math.inf, 0.0)


@pytest.mark.parametrize(("mass", "friction"), [(0.05, 0.3), (0.15, 0.6)])
def test_a_load_that_friction_allows_is_lifted_hardly_tighter_than_needed(
    world: PairWorld, mass: float, friction: float
) -> None:
    result = lift(world, Now(), load_of(mass, friction), truth(), GRIP)
    assert result.lifted, result.reason
    assert 1.0 < result.force / result.load.least < 2.0


def test_a_load_that_friction_forbids_is_set_down_and_let_go(world: PairWorld) -> None:
    result = lift(world, Now(), load_of(0.4, 0.25), truth(), GRIP)
    assert not result.lifted
    assert result.state == State.OPENED
    assert "counts from touch" in result.reason


def test_one_force_without_feedback_drops_what_it_does_not_hold(world: PairWorld) -> None:
    load, weak = load_of(0.15, 0.5), GripSettings(least=0.6, friction=1e6)
    assert not lift(world, Now(), load, truth(slips=False), weak).lifted
    strong = replace(weak, least=1.2 * load.least)
    assert lift(world, Now(), load, truth(slips=False), strong).lifted


def test_a_finger_that_stops_to_feel_leaves_the_grip_closed(world: PairWorld) -> None:
    feel, commands = truth(), []

    def stale(world_: PairWorld, state):  # type: ignore[no-untyped-def]
        left, right = feel(world_, state)
        return replace(left, t_ns=min(left.t_ns, 5_900_000_000)), right

    result = lift(
        world,
        Now(),
        load_of(0.1, 0.5),
        stale,
        GRIP,
        lambda *seen: commands.append(seen[2].position),
    )
    assert (result.state, result.lifted) == (State.GIVEN_UP, False)
    assert "ms old" in result.reason
    assert commands == sorted(commands)
    assert result.force > 0.2


def test_drawn_objects_of_a_seed_are_the_same_and_forces_are_those_of_their_weight() -> None:
    loads = drawn_loads(3, 12)
    assert loads == drawn_loads(3, 12) != drawn_loads(4, 12)
    for load in loads:
        friction = SKIN * load.object.friction
        assert load.least == pytest.approx(load.object.mass * GRAVITY / 2 / friction)
        assert 0 < load.most < load.beyond
        # Two skins in series, each of at most 10 N/mm.
        assert 0 < load.count < 5e3 * COUNT
    kinds = {replace(loads[0], least=least, most=2.0, beyond=3.0).kind for least in (1.0, 2.5, 4.0)}
    assert kinds == {"allowed", "limit", "forbidden"}


def test_a_slip_is_noticed_late_never_or_falsely() -> None:
    result = Lift(load_of(0.1, 0.5))
    result.slid(1_000_000_000, 60e-6)
    result.slid(1_040_000_000 + LATENCY_NS, 90e-6, notice=True)
    result.slid(1_100_000_000, 91e-6, notice=True)
    assert result.noticed == pytest.approx([0.04])
    assert result.false_alarms == 1
    result.slid(1_200_000_000, 150e-6)
    result.slid(1_300_000_000, 150e-6, notice=False)
    assert result.noticed[1] == math.inf


def test_lifts_are_counted_by_kind_and_forces_by_counts() -> None:
    fine = Load(load_of(0.1, 0.5).object, 1.0, 2.0, 3.0, 0.4)
    lifts = [
        Lift(fine, lifted=True, force=1.2),
        Lift(fine, lifted=False, force=9.0),
        Lift(replace(fine, count=0.6), lifted=True, force=2.0),
        Lift(replace(fine, least=4.0), lifted=False),
    ]
    assert counted(lifts, "allowed", lifted=True) == "2 of 3"
    assert counted(lifts, "forbidden", lifted=False) == "1 of 1"
    assert (ratio(lifts, fine=True), ratio(lifts, fine=False)) == ("1.20", "2.00")


def test_presses_for_the_model_begin_without_contact_and_end_sheared() -> None:
    presses = SimulatedPresses()
    made = presses.read(slice(5 * LENGTH, 6 * LENGTH))
    wrench = made.table["wrench"]
    assert made.packed.shape == (LENGTH, 38400)
    assert np.unpackbits(made.packed[0] ^ presses.plan.references[0]).mean() < 1e-3
    assert wrench[0].tolist() == [0.0] * 6
    assert wrench[-1, 2] < -0.3 < 0.1 < np.hypot(*wrench[-1, :2])


@pytest.mark.slow
def test_the_demo_lifts_by_pictures(capsys: pytest.CaptureFixture[str]) -> None:
    run_module(tactile.grip, "--demo", "--lifts", 4, "--seed", 2)
    assert "lifted 4 of 4  grip margin" in capsys.readouterr().out
