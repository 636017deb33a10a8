"""Properties of the plans: the paper's counts, closed paths, maximum depth, JSON round trip."""

import itertools
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajectories import (
    PHASES,
    ForceDepth,
    Limits,
    Plan,
    PressShear,
    dry_run,
    move_duration,
    plan_from_json,
    plan_to_json,
)

MM = 1e-3
HOMOGENEOUS = PressShear(3 * MM, 4 * MM, 0.3 * MM, 1.2 * MM, math.radians(30), 1 * MM)
MATERIAL = PressShear(3 * MM, 4 * MM, 0.3 * MM, 1.2 * MM, math.radians(30), 1 * MM, points=(1,))
HETEROGENEOUS = PressShear(3 * MM, 4 * MM, 0.25 * MM, 1 * MM, math.radians(45), 1 * MM)
INDENTERS = 18
KEPT_FRAMES = 4  # the last frame of each phase makes a location pair

press_shears = st.builds(
    lambda x, y, step, levels, directions, shear, clearance, points, layout, order: PressShear(
        x, y, step, step * levels, 2 * math.pi / directions, shear, clearance, points, layout, order
    ),
    st.floats(1e-4, 1e-2),
    st.floats(1e-4, 1e-2),
    st.floats(1e-5, 2e-3),
    st.integers(1, 6),
    st.integers(1, 16),
    st.floats(1e-4, 3e-3),
    st.floats(1e-5, 1e-3),
    st.lists(st.integers(1, 5), min_size=1, max_size=5, unique=True).map(tuple),
    st.sampled_from(("corners", "cross")),
    st.sampled_from(("authors", "quadrants")),
)
plans = st.one_of(press_shears, st.builds(ForceDepth, st.floats(1e-4, 5e-3), st.integers(1, 5)))


@pytest.mark.parametrize(
    ("plan", "targets", "pairs"),
    [(HOMOGENEOUS, 240, 17_280), (MATERIAL, 48, 3_456), (HETEROGENEOUS, 160, 11_520)],
    ids=["homogeneous", "material", "heterogeneous"],
)
def test_counts_are_those_of_the_paper(plan: PressShear, targets: int, pairs: int) -> None:
    assert len(plan) == targets
    assert sum(len(plan.moves(target)) for target in plan.targets()) == 4 * targets
    assert INDENTERS * KEPT_FRAMES * len(plan) == pairs


@given(plans)
def test_a_plan_is_as_long_as_it_says_and_numbered(plan: Plan) -> None:
    targets = list(plan.targets())
    assert len(targets) == len(plan)
    assert [target.index for target in targets] == list(range(len(plan)))


@given(plans)
def test_no_place_is_below_the_deepest_depth(plan: Any) -> None:
    for target in plan.targets():
        assert target.depth <= plan.depth_max * (1 + 1e-12)
        for move in plan.moves(target):
            assert min(move.start[2], move.end[2]) >= -target.depth * (1 + 1e-12)


@given(plans)
def test_every_target_is_a_closed_unbroken_path_from_above(plan: Plan) -> None:
    for target in plan.targets():
        moves = plan.moves(target)
        assert moves[0].start == moves[-1].end == target.origin
        assert target.origin[2] > 0
        for before, after in itertools.pairwise(moves):
            assert before.end == after.start


@given(press_shears)
def test_the_four_phases_press_shear_and_come_back(plan: PressShear) -> None:
    for target in plan.targets():
        normal_inc, shear_inc, shear_dec, normal_dec = plan.moves(target)
        assert [move.phase for move in plan.moves(target)] == list(range(len(PHASES)))
        assert normal_inc.start[:2] == normal_inc.end[:2] == normal_dec.end[:2]
        assert normal_inc.end[2] == shear_inc.end[2] == -target.depth
        assert math.dist(shear_inc.start, shear_inc.end) == pytest.approx(plan.shear)
        assert (shear_dec.start, shear_dec.end) == (shear_inc.end, shear_inc.start)


@given(press_shears)
def test_directions_go_once_around(plan: PressShear) -> None:
    total = [0.0, 0.0]
    first = [target for target in plan.targets() if target.point == plan.points[0]]
    for target in first:
        total[0] += target.sheared[0] - target.bottom[0]
        total[1] += target.sheared[1] - target.bottom[1]
    assert {target.direction for target in first} == set(range(plan.direction_count))
    if plan.direction_count > 1:
        assert total == pytest.approx([0, 0], abs=1e-9)


@given(plans)
def test_json_gives_the_same_plan_back(plan: Plan) -> None:
    assert plan_from_json(json.loads(json.dumps(plan_to_json(plan)))) == plan


def test_points_are_in_the_order_of_the_papers_authors() -> None:
    # Their collector: centre, left top, left bottom, right bottom, right top, then by depth and
    # counter-clockwise by direction.
    signs = [tuple(np.sign(HOMOGENEOUS.position(point))) for point in range(1, 6)]
    assert signs == [(0, 0), (-1, 1), (-1, -1), (1, -1), (1, 1)]
    second = [target for target in HOMOGENEOUS.targets() if target.point == 2][:13]
    assert [target.direction for target in second] == [*range(12), 0]
    assert second[0].origin[:2] == (-3 * MM, 4 * MM)


def test_a_stored_plan_that_does_not_state_every_field_is_refused() -> None:
    stored = plan_to_json(HOMOGENEOUS)
    del stored["order"]
    with pytest.raises(ValueError, match="plan: order missing; a stored plan states every field"):
        plan_from_json(stored)


@given(press_shears, st.floats(1.01, 50))
def test_on_a_dome_each_press_is_as_deep_below_the_surface_at_its_point(
    plan: PressShear, ratio: float
) -> None:
    farthest = max(math.hypot(*plan.position(point)) for point in plan.points) + plan.shear
    radius = ratio * farthest
    domed = replace(plan, dome_radius=radius)
    for flat, target in zip(plan.targets(), domed.targets(), strict=True):
        drop = radius - math.sqrt(radius**2 - math.hypot(*flat.origin[:2]) ** 2)
        for one, other in zip(
            (flat.origin, flat.bottom, flat.sheared),
            (target.origin, target.bottom, target.sheared),
            strict=True,
        ):
            assert other[:2] == one[:2]
            assert one[2] - other[2] == pytest.approx(drop, abs=1e-12)


def test_the_tacpalms_dome_lowers_its_outer_points_as_the_authors_do() -> None:
    plan = PressShear(
        6.5 * MM, 6.5 * MM, 1.125 * MM, 4.5 * MM, math.radians(45), 1.5 * MM, dome_radius=29 * MM
    )
    heights = [plan.height(*plan.position(point)) for point in range(1, 6)]
    assert heights[0] == 0
    assert heights[1:] == pytest.approx([-1.5 * MM] * 4, abs=0.01 * MM)
    limits = replace(WIDE, depth_max=4.5 * MM)
    walked = dry_run(plan, limits, speed=0.005, acceleration=0.05, dome_radius=29 * MM)
    # A shear towards the apex keeps its height while the surface rises.
    assert walked.depth == pytest.approx(4.957 * MM, abs=1e-6)
    assert any("depth: 4.957 mm" in line for line in walked.broken)


@given(st.floats(1e-6, 0.1), st.floats(1e-4, 0.5), st.floats(1e-3, 5))
def test_a_move_takes_at_least_its_length_over_its_speed(
    length: float, speed: float, acceleration: float
) -> None:
    duration = move_duration(length, speed, acceleration)
    assert duration >= length / speed * (1 - 1e-12)
    assert duration >= math.sqrt(2 * length / acceleration) * (1 - 1e-12)
    assert move_duration(2 * length, speed, acceleration) <= 2 * duration * (1 + 1e-12)


def test_the_profile_is_continuous_where_it_just_reaches_its_speed() -> None:
    edge = 0.005**2 / 0.05
    below = move_duration(edge * (1 - 1e-9), 0.005, 0.05)
    above = move_duration(edge * (1 + 1e-9), 0.005, 0.05)
    assert below == pytest.approx(above, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"depth_max": 1.25 * MM}, "depth_max"),
        ({"depth_step": 0.0}, "depth_step"),
        ({"shear": -1.0}, "shear"),
        ({"shear": math.nan}, "shear"),
        ({"angle_step": 1.0}, "angle_step"),
        ({"points": (1, 6)}, "points"),
        ({"points": (1, 1)}, "points"),
        ({"points": ()}, "points"),
        ({"layout": "star"}, "layout"),
        ({"order": "alphabetical"}, "order: 'alphabetical'; allowed: authors, quadrants"),
        ({"dome_radius": 5.5e-3}, r"dome_radius: 0\.0055; allowed: above 0\.006"),
        ({"dome_radius": math.nan}, "dome_radius"),
        ({"clearance": 0.0}, "clearance"),
    ],
)
def test_a_spec_that_cannot_be_walked_is_refused_by_name(
    change: dict[str, Any], named: str
) -> None:
    stored = plan_to_json(HOMOGENEOUS) | change
    with pytest.raises(ValueError, match=named):
        plan_from_json(stored)


def test_unknown_kinds_and_fields_are_refused() -> None:
    with pytest.raises(ValueError, match="kind"):
        plan_from_json({"kind": "spiral"})
    with pytest.raises(ValueError, match="depth"):
        plan_from_json({"kind": "force_depth", "depth": 1e-3})


WIDE = Limits(
    box_x=(-0.01, 0.01), box_y=(-0.01, 0.01), depth_max=2e-3, height_max=0.01, duration_max=3600.0
)


def test_a_plan_within_its_limits_breaks_none() -> None:
    walked = dry_run(HOMOGENEOUS, WIDE, speed=0.005, acceleration=0.05)
    assert walked.broken == ()
    assert walked.depth == pytest.approx(1.2e-3)
    assert walked.x == pytest.approx((-4e-3, 4e-3))
    assert walked.y == pytest.approx((-5e-3, 5e-3))


@pytest.mark.parametrize(
    ("limit", "value", "word"),
    [
        ("box_x", (-3.9e-3, 0.01), "x:"),
        ("box_x", (-0.01, 3.9e-3), "x:"),
        ("box_y", (-4.9e-3, 0.01), "y:"),
        ("box_y", (-0.01, 4.9e-3), "y:"),
        ("depth_max", 1.19e-3, "depth"),
        ("height_max", 0.2e-3, "height"),
        ("duration_max", 100.0, "duration"),
    ],
)
def test_each_limit_alone_is_found_broken(limit: str, value: Any, word: str) -> None:
    import dataclasses

    limits = dataclasses.replace(WIDE, **{limit: value})
    walked = dry_run(HOMOGENEOUS, limits, speed=0.005, acceleration=0.05)
    assert len(walked.broken) == 1
    assert word in walked.broken[0]
