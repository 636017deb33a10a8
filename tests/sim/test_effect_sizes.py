"""The table of effects agrees with formulas and with full solves."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import sim
from sim import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity
from sim.effect_sizes import EffectSize, _brief, changes, variants
from sim.fem import Fem
from sim.indenters import flat_punch, sphere
from tactile.__main__ import main

BODY = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
PRESS = Scene(sphere(3e-3), sim.press((0.4e-3,)), BODY)


def _sizes(scene: Scene) -> dict[str, EffectSize]:
    return {one.name: one for one in sim.effects_table(scene).sizes}


def test_effects_of_no_strength_and_effects_that_are_off_are_shown_so() -> None:
    nothing = Effects(Friction(0.0), Viscosity((0.0,), (1.0,)), Inertia(0.0), Gravity((0, 0, 0)))
    for one in sim.effects_table(replace(PRESS, effects=nothing)).sizes:
        assert (one.force, one.force_unsure, one.marker, one.marker_unsure) == (0, 0, 0, 0)
        assert one.why == "of no strength"
    rows = str(sim.effects_table(PRESS)).splitlines()[1:-1]
    assert [row.split() for row in rows] == [
        [name, "0", "%", "0", "px", "0", "%", "off"]
        for name in ("friction", "viscosity", "inertia", "gravity")
    ]


@pytest.mark.parametrize(("speed", "times"), [(1e-8, 1.0), (1.0, 1.5)])
def test_viscosity_is_worth_nothing_in_a_slow_press_and_the_ratio_of_moduli_in_a_fast_one(
    speed: float, times: float
) -> None:
    scene = replace(PRESS, motion=sim.press((0.4e-3,), speed=speed))
    one = _sizes(replace(scene, effects=Effects(viscosity=Viscosity((0.5,), (1.0,)))))["viscosity"]
    assert one.force == pytest.approx(1 - 1 / times, abs=0.01)
    assert one.marker is not None
    assert one.marker < 0.2  # the shape hardly depends on the modulus


@pytest.mark.parametrize("pull", [-200.0, 200.0])
def test_gravity_is_worth_the_sag_of_the_layer_over_the_depth(pull: float) -> None:
    body, depth = Body(size_x=40e-3, size_y=40e-3), 0.1e-3
    confined = body.bulk_modulus + 4 / 3 * body.shear_modulus
    sag = body.density * abs(pull) * body.thickness**2 / (2 * confined)
    scene = Scene(flat_punch(3e-3, 0.2e-3), sim.press((depth,)), body)
    one = _sizes(replace(scene, effects=Effects(gravity=Gravity((0.0, 0.0, pull)))))["gravity"]
    # Pulled up, the skin touches before it is pressed: as a fraction of a tenth of the force.
    expected = sag / (depth - sag) if pull < 0 else sag / (0.1 * (depth + sag))
    assert one.force == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("poisson", [0.0, 0.45, 0.49])
def test_friction_is_worth_what_a_punch_that_sticks_to_a_half_space_adds(poisson: float) -> None:
    # Mossakovskii (1963): (1 - nu) ln(3 - 4 nu) / (1 - 2 nu) times the force without friction.
    ratio = (1 - poisson) * math.log(3 - 4 * poisson) / (1 - 2 * poisson)
    body = Body(size_x=24e-3, size_y=24e-3, thickness=12e-3, poisson=poisson)
    scene = Scene(flat_punch(2e-3, 0.3e-3), sim.press((0.1e-3,)), body, Effects(Friction(2.0)))
    one = _sizes(scene)["friction"]
    assert one.force is not None
    assert one.force_unsure is not None
    assert one.force == pytest.approx(1 - 1 / ratio, abs=one.force_unsure)
    assert one.force_unsure < 0.03


def test_friction_takes_time_where_it_needs_more_steps() -> None:
    scene = replace(PRESS, motion=sim.press((0.8e-3,)), effects=Effects(Friction(0.5)))
    one = _sizes(scene)["friction"]
    assert one.time is not None
    assert 0.2 < one.time < 1


def test_many_frames_along_straight_lines_are_thinned_but_corners_stay() -> None:
    motion = sim.press((0.4e-3, 0.2e-3, 0.6e-3), steps=50, shear=0.1e-3)
    brief = _brief(motion)
    assert len(brief) < 20
    assert (brief.tip[0], brief.tip[-1]) == (motion.tip[0], motion.tip[-1])
    for corner in sim.press((0.4e-3, 0.2e-3, 0.6e-3), shear=0.1e-3).tip:
        assert np.abs(np.array(brief.tip) - corner).max(axis=1).min() < 1e-12
    assert all(a < b for a, b in pairwise(brief.time))
    one = Motion(((0.0, 0.0, -1e-4),), (0.0,))
    assert _brief(one) == one


def test_a_press_beside_the_body_and_one_without_a_solution_have_reasons() -> None:
    beside = Motion(((9e-3, 0.0, 0.0), (9e-3, 0.0, -0.4e-3)), (0.0, 1e-3))
    scene = replace(PRESS, effects=Effects(gravity=Gravity((0.0, 0.0, -40.0))))
    gravity = _sizes(replace(scene, motion=beside, indenter=sphere(0.5e-3)))["gravity"]
    assert (gravity.force, gravity.why) == (None, "no contact")
    assert gravity.marker is not None
    # 43 times as heavy as it is stiff.
    torn = replace(scene.effects, gravity=Gravity((0.0, 0.0, 1e3)))
    table = sim.effects_table(replace(scene, body=replace(BODY, modulus=1e2), effects=torn))
    assert "no coarse solution: " in table.sizes[0].why
    assert table.sizes[0].force is None
    assert "?" in str(table)


def test_the_command_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    press = ["sim", "press", "--size", "8,8,4", "--depths", "0.2", "--inertia", "--effects"]
    assert main(press) == 0
    assert "\ninertia    " in capsys.readouterr().out
    assert main([*press, "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["effects"]
    assert one["name"] == "inertia"
    assert 0 < one["force"] < 2 * one["force_unsure"] < 0.02


@pytest.mark.slow
def test_the_table_agrees_with_full_solves() -> None:
    effects = Effects(Friction(0.4), Viscosity((0.2,), (1e-2,)), Inertia(), Gravity((9.81, 0, 0)))
    scene = replace(PRESS, motion=sim.press((0.4e-3,), shear=0.2e-3), effects=effects)
    scenes = variants(scene)
    full, hardly, *less = sim.simulate_many([*scenes.values()], Fem(fineness=0.5))
    assert max(changes(full, hardly)) < 0.01
    for (name, one), without in zip(_sizes(scene).items(), less, strict=True):
        force, marker = changes(full, without)
        assert one.force == pytest.approx(force, abs=one.force_unsure), name
        assert one.marker == pytest.approx(marker, abs=one.marker_unsure), name
