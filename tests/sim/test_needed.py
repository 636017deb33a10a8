"""Negligible effects are omitted, judged jointly, and their error is reported."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sim
from benchmarks.accuracy.cases import compare
from sim import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, SceneError, Viscosity
from sim import needed as module
from sim.effect_bounds import bounds_of
from sim.fem import Fem
from sim.indenters import sphere
from sim.metrics import outcome_of, tolerance_of
from sim.needed import EffectsPlan, part_of_tolerance, plan_many
from sim.planning import plan_effects
from sim.result import Result
from sim.tiers import simulate_many
from tactile.__main__ import main

BODY = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
# Down and slightly sideways, one second per millimetre.
SLOW = Motion(((0.0, 0.0, 0.0), (0.0, 0.0, -0.4e-3), (0.2e-3, 0.0, -0.4e-3)), (0.0, 0.4, 0.6))
RUBS = Scene(sphere(3e-3), SLOW, BODY, Effects(friction=Friction(0.5), inertia=Inertia()))
PULLED = Effects(viscosity=Viscosity((0.05,), (1e-3,)), gravity=Gravity((0.0, 0.0, -40.0)))
TWO = replace(RUBS, effects=PULLED)


def _by_name(found: EffectsPlan) -> dict[str, Any]:
    return {one.name: one for one in found.effects}


@pytest.mark.slow
def test_a_slow_press_needs_no_inertia_but_its_friction() -> None:
    result = sim.plan(RUBS, "6 %", effects="needed").run()
    assert result.scene.effects == Effects(friction=Friction(0.5))
    told = result.record["effects"]
    assert json.loads(json.dumps(told)) == told
    assert (told["kept"], told["left_out"]) == (["friction"], ["inertia"])
    assert told["asked"]["inertia"] == {"scale": 1.0}
    assert told["each"][-1]["name"] == "friction"
    assert told["each"][-1]["percent"] > 20
    error = result.record["error"]
    assert 0 < error["effects_percent"] < 0.1
    assert error["percent"] == error["mesh_percent"] + error["effects_percent"] <= 6
    assert 100 * max(error["force"]) <= 1.001 * error["percent"]
    assert result.record["plan"]["tolerance"] == "6 %"


@pytest.mark.slow
def test_what_is_said_is_what_leaving_it_out_changes_on_a_finer_mesh() -> None:
    (found,) = plan_many([TWO], tolerance="9 %")
    assert set(found.omitted) == {"viscosity", "gravity"}
    assert found.joint_by == "probe"
    finer = Fem(fineness=0.5)
    full, less = (sim.simulate(one, finer) for one in (TWO, found.needed))
    true = compare(outcome_of(less), outcome_of(full), BODY).worst()
    assert (
        0.3 * found.joint.value("fraction") < true["force_share"] <= found.joint.value("fraction")
    )
    assert 0 < true["marker_rms"] <= found.joint.marker


@pytest.mark.slow
def test_a_probe_that_does_not_touch_tells_nothing_of_forces() -> None:
    beside = Motion(((7.5e-3, 0.0, 0.0), (7.5e-3, 0.0, -0.4e-3)), (0.0, 1e-3))
    scene = replace(TWO, motion=beside, indenter=sphere(2e-3))
    (found,) = plan_many([scene], tolerance="2 %")
    assert found.omitted == ()
    assert {one.by for one in found.effects} == {"no contact"}
    (of_markers,) = plan_many([scene], tolerance="90 px")
    assert {one.by for one in of_markers.effects} == {"probe"}


@pytest.mark.slow
def test_effects_are_judged_together() -> None:
    worth = _by_name(plan_effects(TWO))
    each = sorted(one.change.value("fraction") for one in worth.values())
    # Enough for the larger one alone, but not for both together.
    room = module.SAFETY * (each[1] + 0.25 * each[0])
    found = plan_effects(TWO, f"{100 * room / module.PART:.6f} %")
    assert found.tolerance is not None
    assert part_of_tolerance(found.tolerance) == pytest.approx(room, rel=1e-3)
    for one in found.effects:
        assert one.change is not None
        assert module.SAFETY * one.change.value("fraction") <= room
    assert len(found.omitted) == 1
    assert found.omitted[0] == found.effects[0].name
    assert found.joint.value("fraction") <= room


def test_without_effects_there_is_no_probe_and_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plain = replace(RUBS, effects=Effects(), motion=sim.press((0.3e-3,)))
    before = sim.plan(plain, "9 %").run()
    monkeypatch.setattr(module, "simulate_many", _refused)
    after = sim.plan(plain, "9 %", effects="needed").run()
    np.testing.assert_array_equal(after.wrench, before.wrench)
    np.testing.assert_array_equal(after.surface, before.surface)
    assert after.record["error"] == before.record["error"]
    assert after.record["effects"]["probes"]["count"] == 0
    assert str(plan_effects(plain)) == "the scene has no effects"


def _refused(*_scenes: Any, **_options: Any) -> list[Result]:
    raise AssertionError("a probe was solved")


def test_effects_of_no_strength_are_left_out_without_a_probe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "simulate_many", _refused)
    nothing = Effects(Friction(0.0), Viscosity((0.0,), (1.0,)), Inertia(0.0), Gravity((0, 0, 0)))
    found = plan_effects(replace(RUBS, effects=nothing), "2 %")
    assert set(found.omitted) == {"friction", "viscosity", "inertia", "gravity"}
    assert found.joint.value("fraction") == 0
    assert found.needed.effects == Effects()


@pytest.mark.parametrize(
    ("tolerance", "effects", "message"),
    [
        ("2 %", "some", "effects: 'some'; allowed: 'all', 'needed'"),
        ("2", "needed", "tolerance: '2'; allowed: a number above 0"),
    ],
)
def test_wrong_words_are_refused(tolerance: str, effects: Any, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        sim.plan(RUBS, tolerance, effects=effects)
    with pytest.raises(SceneError, match="tolerance: 'some'"):
        plan_effects(RUBS, "some")


@pytest.mark.slow
@pytest.mark.parametrize("speed", [pytest.param(1e-3, marks=pytest.mark.slow), 0.1])
def test_a_bound_is_no_less_than_the_probe(speed: float) -> None:
    wide = Body(size_x=16e-3, size_y=16e-3, thickness=2e-3)
    effects = Effects(
        viscosity=Viscosity((0.3,), (1e-4 / speed * 1e-3,)), inertia=Inertia(), gravity=Gravity()
    )
    scene = Scene(sphere(3e-3), sim.press((0.15e-3, 0.3e-3), speed=speed), wide, effects)
    bounds = bounds_of(scene, effects.key)
    assert set(bounds) == set(effects.key)
    # At zero strength instead of off: the steps, and all that depends on them, are the same.
    weak = [
        replace(scene, effects=replace(effects, **{name: getattr(effects, name).weakened(0.0)}))
        for name in effects.key
    ]
    full, *rest = simulate_many([scene, *weak], Fem(fineness=0.3, tolerance=1e-5))
    for name, less in zip(effects.key, rest, strict=True):
        assert isinstance(full, Result)
        assert isinstance(less, Result)
        true = compare(outcome_of(less), outcome_of(full), wide).worst()
        assert 0 < true["force_share"] <= bounds[name].value("fraction"), name
        assert 0 < true["marker_rms"] <= bounds[name].marker, name


def test_what_layer_does_not_know_has_no_bound() -> None:
    assert bounds_of(RUBS, ("friction", "inertia")) == {}  # near the sides
    wide = replace(RUBS, body=Body())
    assert set(bounds_of(wide, ("friction", "inertia"))) == {"inertia"}
    inside = Motion(((0.0, 0.0, -0.1e-3), (0.0, 0.0, -0.2e-3)), (0.0, 1.0))
    assert bounds_of(replace(wide, motion=inside), ("inertia",)) == {}
    domed = replace(wide, body=Body(dome_radius=0.1))
    assert bounds_of(domed, ("inertia",)) == {}


def test_the_rest_of_a_tolerance_is_never_rounded_up() -> None:
    for value in (0.0199999, 0.01, 1.23456e-3, 0.15):
        for kind, factor in (("fraction", 1.0), ("force", 1.0), ("marker", 1.0)):
            text = module._text(kind, factor * value)  # type: ignore[arg-type]
            rest = tolerance_of(text)
            assert rest.kind == kind
            assert 0.999 * value <= rest.value <= value * (1 + 1e-12)


@pytest.mark.slow
def test_the_command_line_tells_what_effects_are_worth(capsys: pytest.CaptureFixture[str]) -> None:
    press = ["sim", "press", "--size", "8,8,4", "--depths", "0.4", "--inertia", "--plan-effects"]
    assert main([*press, "--tolerance", "3 %"]) == 0
    table = capsys.readouterr().out
    assert "left out: inertia; together" in table
    assert main([*press, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["left_out"] == []
    assert [one["name"] for one in told["each"]] == ["inertia"]
    assert main([*press, "--out", "x.png"]) == 2
    assert "--out: x.png with --plan-effects; allowed: without" in capsys.readouterr().err
    assert main(["sim", "press", "--effects", "needed"]) == 2
    assert "--effects: 'needed' without --tolerance" in capsys.readouterr().err
