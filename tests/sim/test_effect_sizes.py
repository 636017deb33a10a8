"""The table of effects agrees with formulas and with full solves."""

import json
from dataclasses import replace

import pytest

import sim
from sim import Body, Effects, Friction, Gravity, Inertia, Scene, Viscosity
from sim.effect_sizes import EffectSize, changes
from sim.fem import Fem
from sim.indenters import sphere
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
    assert str(sim.effects_table(PRESS)).count("off") == 4


@pytest.mark.parametrize(("speed", "times"), [(1e-8, 1.0), (1.0, 1.5)])
def test_viscosity_is_worth_nothing_in_a_slow_press_and_the_ratio_of_moduli_in_a_fast_one(
    speed: float, times: float
) -> None:
    scene = replace(PRESS, motion=sim.press((0.4e-3,), speed=speed))
    one = _sizes(replace(scene, effects=Effects(viscosity=Viscosity((0.5,), (1.0,)))))["viscosity"]
    assert one.force is not None
    assert one.force_unsure is not None
    # Without it the force is that of the modulus at rest, of `times` of which it is a part.
    assert one.force == pytest.approx(1 - 1 / times, abs=min(one.force_unsure, 0.01))


def test_the_command_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    press = ["sim", "press", "--size", "8,8,4", "--depths", "0.2", "--inertia", "--effects"]
    assert main(press) == 0
    assert "inertia" in capsys.readouterr().out
    assert main([*press, "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["effects"]
    assert one["name"] == "inertia"
    assert one["force"] < one["force_unsure"]


@pytest.mark.slow
def test_the_table_agrees_with_full_solves() -> None:
    effects = Effects(Friction(0.4), Viscosity((0.2,), (1e-2,)), Inertia(), Gravity((9.81, 0, 0)))
    scene = replace(PRESS, motion=sim.press((0.4e-3,), shear=0.2e-3), effects=effects)
    full = sim.simulate(scene, Fem(fineness=0.5))
    for name, one in _sizes(scene).items():
        less = replace(scene, effects=replace(effects, **{name: None}))
        force, marker = changes(full, sim.simulate(less, Fem(fineness=0.5)))
        assert one.force == pytest.approx(force, abs=one.force_unsure), name
        assert one.marker == pytest.approx(marker, abs=one.marker_unsure), name
