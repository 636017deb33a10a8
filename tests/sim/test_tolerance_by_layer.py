"""Tolerances that `layer` satisfies, and those that need meshes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sim.tolerance as module
from benchmarks.sim.independent.comparison import round_tasks
from sim import Body, Scene, press, simulate
from sim.effects import Effects, Friction
from sim.errors import SceneError, SimulationDiverged
from sim.indenters import flat_punch, named, sphere
from sim.metrics import force_scale
from sim.result import Result
from sim.scene import through

# A contact 33 pixels wide, pressed by a fortieth of the thickness: 5.7 % by its estimate.
WIDE = Scene(flat_punch(3e-3, 0.5e-3), press([0.05e-3, 0.1e-3]))
ASIDE = through([(5.5e-3, 0, 0), (5.5e-3, 0, -1e-4)], speed=1e-2)
DEEP = Scene(sphere(4e-3), press([0.8e-3]))


@pytest.fixture
def no_meshes(monkeypatch: pytest.MonkeyPatch) -> None:
    def rejected(*_arguments: Any, **_options: Any) -> Result:
        raise AssertionError("fem was solved")

    monkeypatch.setattr(module._Meshes, "solved", rejected)
    monkeypatch.setattr(module, "simulate_one", rejected)


@pytest.mark.usefixtures("no_meshes")
def test_layer_is_taken_where_its_estimate_is_below_and_says_why() -> None:
    result = simulate(WIDE, tolerance="8 %")
    alone = simulate(WIDE, "layer")
    np.testing.assert_array_equal(result.wrench, alone.wrench)
    error, plan = result.record["error"], result.record["plan"]
    assert error["status"] == "estimated"
    assert error["percent"] == alone.record["error"]["percent"] <= 8
    assert error["newton"] == pytest.approx(
        max(np.array(error["force"])[1:] * -result.force[1:, 2]), rel=1e-3
    )
    assert plan["chosen"] == "layer"
    assert plan["tried"] == []
    assert 0 < plan["seconds"] < 60
    (note,) = plan["notes"]
    assert "up to 0.025 of the thickness" in note
    assert "33 pixels wide" in note
    assert "1.9 thicknesses from any side" in note
    assert "not measured" in note


@pytest.mark.parametrize(
    ("name", "percent"),
    [
        ("punch 3/0.2 in 4, mu 0, nu 0.3, to 0.05", 8.0),
        ("sphere 20 in 2, mu 0, nu 0.49, to 0.8", 31.0),
        ("sphere 4 in 1, mu 0, nu 0.45, to 0.4", 32.0),
    ],
)
@pytest.mark.usefixtures("no_meshes")
def test_its_forces_are_within_the_tolerance_of_the_truth(name: str, percent: float) -> None:
    (task,) = round_tasks([name])
    result = simulate(task.scene, tolerance=f"{percent:g} %")
    assert result.tier == "layer"
    truths = np.array([-truth[2] for truth in task.truths])
    off = np.abs(-result.force[list(task.frames), 2] - truths)
    assert (off <= percent / 100 * np.maximum(truths, 0.1 * truths.max())).all()


@pytest.mark.parametrize(
    "scene",
    [
        Scene(named("hemisphere"), press([0.1e-3, 0.3e-3])),
        Scene(
            flat_punch(4e-3, 0.8e-3).tilted(0.03, 0.0),
            through([(5e-4, 0, 0), (5e-4, 0, -1e-4), (0, 5e-4, -1e-4)], speed=1e-2),
            Body(16e-3, 16e-3, 2e-3),
        ),
    ],
    ids=["hemisphere", "leaning and sliding"],
)
def test_its_estimate_covers_what_meshes_measure(scene: Scene) -> None:
    result = simulate(scene, tolerance="20 %")
    meshes = simulate(scene, "fem", tolerance="3 %")
    assert (result.tier, meshes.tier) == ("layer", "fem")
    off = np.abs(result.force - meshes.force).max(axis=1) / force_scale(meshes.force)
    own, theirs = (np.array(one.record["error"]["force"]) for one in (result, meshes))
    assert (off <= own + theirs).all()


def test_meshes_go_on_where_its_estimate_is_above_and_the_look_is_counted() -> None:
    result = simulate(WIDE, tolerance="5 %")
    plan = result.record["plan"]
    assert result.tier == plan["chosen"] == "fem"
    assert result.record["error"]["status"] == "measured"
    assert plan["tried"][0].startswith("layer: ")
    assert "estimated" in plan["tried"][0]
    parts = result.record["seconds"]
    assert plan["seconds"] > sum(value for value in parts.values() if isinstance(value, float))


@pytest.mark.parametrize(
    "scene",
    [
        DEEP,
        replace(WIDE, effects=Effects(friction=Friction(0.3))),
        replace(WIDE, body=replace(WIDE.body, poisson=0.4999)),
        replace(WIDE, body=replace(WIDE.body, poisson=0.0)),
        replace(WIDE, body=replace(WIDE.body, footprint="ellipse")),
        replace(WIDE, body=replace(WIDE.body, dome_radius=0.5)),
        Scene(sphere(4e-3), press([1.7e-3])),
    ],
    ids=["deep", "friction", "incompressible", "cork", "round", "dome", "deeper than truths"],
)
def test_scenes_that_it_was_not_held_against_are_not_tried(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solved(*_arguments: Any, **_options: Any) -> Any:
        raise AssertionError("layer was solved")

    def mesh(*_arguments: Any, **_options: Any) -> Any:
        raise SimulationDiverged("a mesh was tried")

    monkeypatch.setattr(module, "solved_by_layer", solved)
    monkeypatch.setattr(module._Meshes, "solved", mesh)
    tolerance = "30 %" if scene.motion.depth_max > 1e-3 else "8 %"
    with pytest.raises(SimulationDiverged, match="a mesh was tried"):
        simulate(scene, tolerance=tolerance)


@pytest.mark.parametrize(
    ("scene", "tolerance", "tried"),
    [
        (replace(WIDE, motion=ASIDE), "9 %", "from a side"),
        (
            Scene(flat_punch(6e-3, 0.2e-3), press([20e-6]), Body(14e-3, 14e-3, 1e-3)),
            "9 %",
            "thicknesses wide",
        ),
        (WIDE, "1 mN", "estimated"),
    ],
    ids=["near a side", "wider than truths", "newton"],
)
def test_answers_that_are_no_such_thing_are_left_to_meshes(
    scene: Scene, tolerance: str, tried: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[str] = []
    look = module._of_layer

    def kept(*arguments: Any) -> Result | None:
        found = look(*arguments)
        reported.extend(arguments[3])
        return found

    def mesh(*_arguments: Any, **_options: Any) -> Any:
        raise SimulationDiverged("a mesh was tried")

    monkeypatch.setattr(module, "_of_layer", kept)
    monkeypatch.setattr(module._Meshes, "solved", mesh)
    with pytest.raises(SimulationDiverged, match="a mesh was tried"):
        simulate(scene, tolerance=tolerance)
    assert len(reported) == 1
    assert tried in reported[0]


@pytest.mark.usefixtures("no_meshes")
def test_a_tier_that_is_named_is_taken_or_refused() -> None:
    assert simulate(WIDE, "layer", tolerance="8 %").tier == "layer"
    rubs = replace(WIDE, effects=Effects(friction=Friction(0.3)))
    assert simulate(rubs, "layer", tolerance="8 %").record["plan"]["chosen"] == "layer"
    with pytest.raises(SceneError, match=r"'5 %' with tier 'layer'; layer: 5.*estimated; allowed"):
        simulate(WIDE, "layer", tolerance="5 %")
    with pytest.raises(SceneError, match=r"markers not known.*allowed: tier 'fem'"):
        simulate(WIDE, "layer", tolerance="5 px")
    near = replace(WIDE, motion=ASIDE)
    with pytest.raises(SceneError, match="from a side of the body"):
        simulate(near, "layer", tolerance="50 %")
    with pytest.raises(AssertionError, match="fem was solved"):
        simulate(WIDE, "fem", tolerance="8 %")
    with pytest.raises(AssertionError, match="fem was solved"):
        simulate(WIDE, tolerance="8 %", error_bar=True)


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        ({"tier": "mpm"}, "tier: 'mpm' with a tolerance; allowed: None, 'layer', 'fem'"),
        ({"tier": "layer", "error_bar": True}, "error_bar: True with tolerance '8 %' and tier"),
        ({"numerics": 3}, "numerics: 3 with a tolerance; allowed: None"),
        ({"device": "cuda:99"}, "device: 'cuda:99'; allowed"),
    ],
)
def test_what_goes_with_no_tolerance_is_refused(options: dict[str, Any], reported: str) -> None:
    with pytest.raises(SceneError, match=reported):
        simulate(WIDE, tolerance="8 %", **options)
