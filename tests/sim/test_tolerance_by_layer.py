"""Tolerances that `layer` satisfies, and those that need meshes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sim.tolerance as module
from benchmarks.independent.comparison import scene_of
from benchmarks.independent.presses import PRESSES
from sim import Body, Fem, Layer, Scene, plan, press, simulate
from sim.errors import SceneError, SimulationDiverged
from sim.indenters import flat_punch, named, sphere
from sim.result import Result, force_scale
from sim.scene import Effects, Friction, through

# A contact 33 pixels wide, pressed by a fortieth of the thickness: 5.7 % by its estimate.
WIDE = Scene(flat_punch(3e-3, 0.5e-3), press([0.05e-3, 0.1e-3]))
ASIDE = through([(5.5e-3, 0, 0), (5.5e-3, 0, -1e-4)], speed=1e-2)
DEEP = Scene(sphere(4e-3), press([0.8e-3]))


@pytest.fixture
def no_meshes(monkeypatch: pytest.MonkeyPatch) -> None:
    def rejected(*_arguments: Any, **_options: Any) -> Result:
        raise AssertionError("fem was solved")

    monkeypatch.setattr(module._Chain, "solve", rejected)


@pytest.fixture
def meshes_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    def mesh(*_arguments: Any, **_options: Any) -> Any:
        raise SimulationDiverged("a mesh was tried")

    monkeypatch.setattr(module._Chain, "solve", mesh)


@pytest.mark.usefixtures("no_meshes")
def test_layer_is_taken_where_its_estimate_is_below_and_says_why() -> None:
    result = plan(WIDE, "8 %").run()
    alone = simulate(WIDE, Layer())
    np.testing.assert_array_equal(result.wrench, alone.wrench)
    error, told = result.record["error"], result.record["plan"]
    assert error["status"] == "estimated"
    assert error["percent"] == alone.record["error"]["percent"] <= 8
    assert error["newton"] == pytest.approx(
        max(np.array(error["force"])[1:] * -result.force[1:, 2]), rel=1e-3
    )
    assert told["chosen"] == "layer"
    assert told["tried"] == []
    assert 0 < told["seconds"] < 60
    (note,) = told["notes"]
    assert "up to 0.025 of the thickness" in note
    assert "33 pixels wide" in note
    assert "1.9 thicknesses from any side" in note
    assert "not measured" in note


@pytest.mark.parametrize(
    ("name", "percent"),
    [
        ("punch 3/0.2 in 4, mu 0, nu 0.3, to 0.05", 8.0),
        pytest.param("sphere 20 in 2, mu 0, nu 0.49, to 0.8", 31.0, marks=pytest.mark.slow),
        ("sphere 4 in 1, mu 0, nu 0.45, to 0.4", 32.0),
    ],
)
@pytest.mark.usefixtures("no_meshes")
def test_its_forces_are_within_the_tolerance_of_the_truth(name: str, percent: float) -> None:
    exact = next(press for press in PRESSES if press.name == name)
    result = plan(scene_of(exact), f"{percent:g} %").run()
    assert result.tier == "layer"
    truths = -np.array(exact.forces_n)[:, 2]
    off = np.abs(-result.force[1:, 2] - truths)
    assert (off <= percent / 100 * np.maximum(truths, 0.1 * truths.max())).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        Scene(named("hemisphere"), press([0.1e-3, 0.3e-3])),
        pytest.param(
            Scene(
                flat_punch(4e-3, 0.8e-3).tilted(0.03, 0.0),
                through([(5e-4, 0, 0), (5e-4, 0, -1e-4), (0, 5e-4, -1e-4)], speed=1e-2),
                Body(16e-3, 16e-3, 2e-3),
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["hemisphere", "leaning and sliding"],
)
def test_its_estimate_covers_what_meshes_measure(scene: Scene) -> None:
    result = plan(scene, "20 %").run()
    meshes = plan(scene, "3 %", only="fem").run()
    assert (result.tier, meshes.tier) == ("layer", "fem")
    off = np.abs(result.force - meshes.force).max(axis=1) / force_scale(meshes.force)
    own, theirs = (np.array(one.record["error"]["force"]) for one in (result, meshes))
    assert (off <= own + theirs).all()


@pytest.mark.slow
def test_meshes_go_on_where_its_estimate_is_above_and_the_look_is_counted() -> None:
    result = plan(WIDE, "5 %").run()
    told = result.record["plan"]
    assert result.tier == told["chosen"] == "fem"
    assert result.record["error"]["status"] == "measured"
    assert told["tried"][0].startswith("layer: ")
    assert "estimated" in told["tried"][0]
    parts = result.record["seconds"]
    assert told["seconds"] > sum(value for value in parts.values() if isinstance(value, float))


@pytest.mark.usefixtures("meshes_tried")
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

    monkeypatch.setattr(module, "_of_layer", solved)
    tolerance = "30 %" if scene.motion.depth_max > 1e-3 else "8 %"
    with pytest.raises(SimulationDiverged, match="a mesh was tried"):
        plan(scene, tolerance).run()


@pytest.mark.usefixtures("meshes_tried")
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

    monkeypatch.setattr(module, "_of_layer", kept)
    with pytest.raises(SimulationDiverged, match="a mesh was tried"):
        plan(scene, tolerance).run()
    assert len(reported) == 1
    assert tried in reported[0]


@pytest.mark.usefixtures("no_meshes")
def test_a_tier_that_is_named_is_taken_or_refused() -> None:
    assert plan(WIDE, "8 %", only="layer").run().tier == "layer"
    rubs = replace(WIDE, effects=Effects(friction=Friction(0.3)))
    assert plan(rubs, "8 %", only="layer").run().record["plan"]["chosen"] == "layer"
    with pytest.raises(SceneError, match=r"'5 %' with tier 'layer'; layer: 5.*estimated; allowed"):
        plan(WIDE, "5 %", only="layer").run()
    with pytest.raises(SceneError, match=r"markers not known.*allowed: tier 'fem'"):
        plan(WIDE, "5 px", only="layer").run()
    near = replace(WIDE, motion=ASIDE)
    with pytest.raises(SceneError, match="from a side of the body"):
        plan(near, "50 %", only="layer").run()
    with pytest.raises(AssertionError, match="fem was solved"):
        plan(WIDE, "8 %", only="fem").run()


@pytest.mark.slow
def test_a_plan_says_what_it_would_try() -> None:
    assert plan(WIDE, "8 %").tiers[0] == Layer()
    coarse, fine = plan(WIDE, "8 %", only="fem").tiers
    assert isinstance(coarse, Fem)
    assert isinstance(fine, Fem)
    result = plan(WIDE, "8 %", only="fem").run()
    assert result.record["mesh"]["fineness"] == pytest.approx(fine.fineness)
    told = str(plan(WIDE, "8 %")).splitlines()
    assert told[0] == "error of up to 8 %; effects solved: none"
    cells = " x ".join(map(str, result.record["mesh"]["cells"]))
    assert [line.split(",")[0] for line in told[1:]] == [
        "layer",
        "fem",
        "fem",
        "finer meshes of fem",
    ]
    assert f"fem, {cells} elements: " in told[3]
