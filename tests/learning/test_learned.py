"""Frames outside of what a model learned from: few of a new indenter, most of any other kind."""

import numpy as np
import pytest
from numpy.typing import NDArray
from support.made_up_archives import State, mask_of

from learning.force.intervals import FLAGGED, LearnedShapes, learned_within, shapes_of

DEEPEST_MM, SHEAR_MM = 1.5, 0.6


def frames(
    width_px: float,
    *,
    seed: int,
    sensor: str = "dots",
    count: int = 40,
    depth: tuple[float, float] = (0.0, DEEPEST_MM),
) -> NDArray[np.float64]:
    """Return shapes of frames at random places, depths and shears of an indenter."""
    random = np.random.default_rng(seed)
    # A press begins without contact.
    masks = [rest(sensor)] if depth[0] == 0 else []
    for _ in range(count):
        centre = (float(random.uniform(190, 450)), float(random.uniform(145, 335)))
        deep = float(random.uniform(*depth))
        along, angle = random.uniform(0, SHEAR_MM) * deep / DEEPEST_MM, random.uniform(0, 2 * np.pi)
        shear = (float(along * np.cos(angle)), float(along * np.sin(angle)))
        masks.append(mask_of(sensor, State(centre, width_px, deep, shear)))
    return shapes_of(np.array(masks), rest(sensor))


def rest(sensor: str) -> NDArray[np.bool_]:
    """Return the mask of a sensor without contact."""
    return mask_of(sensor, State((320.0, 240.0), 90.0, 0.0))


@pytest.fixture(scope="module")
def learned() -> LearnedShapes:
    seen = [frames(width, seed=width) for width in (60, 75, 90, 105, 120)]
    held_out = [frames(width, seed=width) for width in (70, 110)]
    return learned_within(np.concatenate(seen), [(np.concatenate(seen), np.concatenate(held_out))])


@pytest.mark.parametrize("width", [65, 85, 100])
def test_few_frames_of_a_new_indenter_are_flagged(learned: LearnedShapes, width: int) -> None:
    assert learned.is_far(frames(width, seed=width)).mean() <= 0.04


def test_a_frame_without_contact_is_not_flagged(learned: LearnedShapes) -> None:
    assert not learned.is_far(shapes_of(rest("dots")[None], rest("dots"))).any()


def test_most_frames_deeper_than_learned_are_flagged(learned: LearnedShapes) -> None:
    depth = (1.5 * DEEPEST_MM, 2 * DEEPEST_MM)
    deep = [frames(width, seed=1, depth=depth, count=30) for width in (60, 85, 100, 120)]
    flagged = [learned.is_far(each).mean() for each in deep]
    # A small indenter moves fewer markers: fewer of its frames are flagged.
    assert np.mean(flagged) > 0.7
    assert min(flagged) > 0.4


@pytest.mark.parametrize("sensor", ["grid", "diamonds", "dense"])
def test_most_frames_of_another_sensor_are_flagged(learned: LearnedShapes, sensor: str) -> None:
    assert learned.is_far(frames(90, seed=2, sensor=sensor, count=30)).mean() > 0.9


def test_the_limit_flags_one_percent_of_the_frames_held_out() -> None:
    random = np.random.default_rng(0)
    seen, held_out = random.normal(size=(2000, 7)), random.normal(size=(2000, 7))
    found = learned_within(seen, [(seen, held_out)])
    assert found.is_far(held_out).mean() == pytest.approx(FLAGGED, abs=1e-3)
    assert found.is_far(random.normal(size=(5_000, 7))).mean() == pytest.approx(FLAGGED, abs=5e-3)
    # Of fewer than 99 frames the farthest is the limit.
    assert not learned_within(seen, [(seen, held_out[:50])]).is_far(held_out[:50]).any()


def test_a_number_that_never_varied_is_far_as_soon_as_it_does() -> None:
    seen = np.random.default_rng(0).normal(size=(200, 7))
    seen[:, 5] = 6.4
    found = learned_within(seen[:100], [(seen[:100], seen[100:])])
    other = seen[100:].copy()
    other[:, 5] = 6.5
    assert found.is_far(other).all()
