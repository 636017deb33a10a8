"""PairWorld against closed forms: balance, hanging, sliding, falling, no energy from nothing."""

from functools import cache

import numpy as np
import pytest

from rig.bench.pair import GraspObject, PairSpec
from rig.bench.worlds import WorldSpec
from rig.mock.world.pair import GRAVITY, PairState, PairWorld

pytest.importorskip("scipy")

STEP_NS = 2_000_000
DOWN = (0.0, 0.0, 1.0)
WIDTH = 0.04


@cache
def world(left: str = "gelsight", right: str = "gelsight") -> PairWorld:
    return PairWorld(PairSpec(WorldSpec(left), WorldSpec(right)))


def squeezed(
    hand: PairWorld, *, mass: float = 0.1, opening: float = 0.0388, friction: float = 1.0
) -> int:
    """Close on an object at 20 mm/s and hold it on the table for 3 s; return the time [ns]."""
    hand.place(GraspObject("can", width=WIDTH, mass=mass, friction=friction))
    start = (hand.step(0, 1, DOWN, False).t_ns if hand._t_ns is None else hand._t_ns) + STEP_NS
    for step in range(80):
        hand.step(start + step * STEP_NS, max(opening, WIDTH - step * 4e-5), DOWN, False)
    end = start + 80 * STEP_NS + 3_000_000_000
    hand.step(end, opening, DOWN, False)
    return end


def held(
    hand: PairWorld, since: int, seconds: float, down: tuple[float, ...], opening: float = 0.0388
) -> list[PairState]:
    count = round(seconds * 1e9 / STEP_NS)
    return [hand.step(since + (k + 1) * STEP_NS, opening, down, True) for k in range(count)]


@pytest.mark.parametrize("right", ["gelsight", "uskin"])
@pytest.mark.parametrize("down", [DOWN, (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.6, 0.8, 0.0)])
def test_balance_and_closure(right: str, down: tuple[float, ...]) -> None:
    hand = world("gelsight", right)
    state = held(hand, squeezed(hand), 0.4, down)[-1]
    normal = -state.wrench[:, 2]
    assert normal.min() > 0.1
    assert normal[1] - normal[0] == pytest.approx(0.1 * GRAVITY * down[0], abs=1e-4)
    closed = state.depth.sum() + 2e-5 * normal.sum()
    assert closed == pytest.approx(WIDTH - 0.0388, abs=1e-7)
    # The load across the grip, from both fingers' frames to the hand's y and z.
    across = state.wrench[0, :2] + state.wrench[1, :2] * (-1, 1)
    np.testing.assert_allclose(across, 0.1 * GRAVITY * np.array(down[1:]), atol=1e-3)


def test_equal_skins_share_the_weight() -> None:
    hand = world()
    states = held(hand, squeezed(hand), 1.0, DOWN)
    np.testing.assert_allclose(states[-1].wrench[:, 1], 0.05 * GRAVITY, atol=1e-3)
    assert states[-1].wrench[0, 3] == pytest.approx(states[-1].wrench[1, 3])
    assert states[-1].slip.max() < 1e-9
    assert not states[-1].dropped


@pytest.mark.parametrize("mass", [0.02, 0.25])
def test_hanging_settles_and_creates_no_energy(mass: float) -> None:
    hand = world()
    states = held(hand, squeezed(hand, mass=mass, opening=0.038), 0.8, DOWN, 0.038)
    fallen = np.array([state.fallen[1] for state in states])
    speed = np.diff(fallen, prepend=0.0) / (STEP_NS / 1e9)
    # What moves has fallen for it, and the skins hold the rest.
    assert (mass * speed**2 / 2 <= mass * GRAVITY * fallen + 1e-12).all()
    assert np.abs(speed[-100:]).max() < 2e-4
    assert (np.diff(np.abs(speed[-100:])) <= 1e-6).all()
    assert not states[-1].dropped


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_too_little_friction_slides_and_drops(friction: float) -> None:
    hand = world()
    states = held(hand, squeezed(hand, friction=friction), 0.2, DOWN)
    last = next(k for k, state in enumerate(states) if state.dropped)
    normal = -states[last // 2].wrench[:, 2].sum()
    times = np.arange(1, last + 1) * STEP_NS / 1e9
    rate = GRAVITY - 0.5 * friction * normal / 0.1
    fallen = np.array([state.fallen[1] for state in states[:last]])
    np.testing.assert_allclose(fallen, rate * times**2 / 2, rtol=0.1, atol=rate * 2e-3 * times[-1])
    np.testing.assert_allclose(states[last - 1].slip, fallen[-1], rtol=0.1)
    assert not states[-1].wrench.any()


def test_limit_of_friction() -> None:
    """Twice friction times normal force is the most that hangs: 2 % less is held, 2 % more not."""
    hand = world()
    since = squeezed(hand)
    normal = -float(hand.step(since + STEP_NS, 0.0388, DOWN, False).wrench[0, 2])
    most = 2 * 0.5 * normal / GRAVITY
    for part, drops in ((0.97, False), (1.03, True)):
        states = held(hand, squeezed(hand, mass=part * most), 0.5, DOWN)
        assert states[-1].dropped is drops


def test_open_hand_drops_only_what_is_lifted() -> None:
    hand = world()
    since = squeezed(hand)
    assert not hand.step(since + STEP_NS, 0.05, DOWN, False).dropped
    assert hand.step(since + 2 * STEP_NS, 0.05, DOWN, True).dropped


def test_views_follow_the_presses() -> None:
    hand = world("gelsight", "uskin")
    hand.place(None)
    still, counts = hand.reading(0).astype(int), hand.reading(1).astype(int)
    squeezed(hand)
    assert hand.reading(0).shape == (480, 640, 3)
    assert hand.reading(1).shape == (16, 3)
    assert np.abs(hand.reading(0) - still).max() > 50
    assert np.abs(hand.reading(1) - counts).max() > 500
