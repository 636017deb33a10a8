from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import processes
from benchmarks.__main__ import main
from benchmarks.hard_cases.mistakes import MISTAKES
from benchmarks.hard_cases.random_scenes import judgement
from benchmarks.hard_cases.random_scenes.geometry import footprint, half_wall
from benchmarks.hard_cases.random_scenes.judgement import (
    SceneOutcome,
    covered,
    judge_scene,
    of_laws,
    unsolved,
)
from benchmarks.hard_cases.random_scenes.referee import (
    LAWS,
    Reading,
    layer_force,
    least_force,
    measured,
    most_force,
)
from benchmarks.hard_cases.random_scenes.scenes import ELEMENTS_MAX, Drawn, drawn
from benchmarks.hard_cases.random_scenes.twins import KINDS, agrees, symmetric, twin_of
from benchmarks.hard_cases.solver import Solver
from benchmarks.processes import OutOfTime, time_limit
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem, Grading
from sim.fem.mesh import meshes_of
from sim.indenters import shapes
from sim.result import Quality, Result, from_json
from sim.scene import Body, Effects, Friction, Motion, Scene, press

MM = 1e-3
BALL = Scene(shapes.sphere(4 * MM), press([0.2 * MM, 0.4 * MM]))


def _made_up(scene: Scene) -> Result:
    """Return a gel that yields exactly where the indenter is, with a force of realistic size."""
    frames, nodes = len(scene.motion), 41
    x = np.linspace(-scene.body.size_x / 2, scene.body.size_x / 2, nodes)
    surface = np.zeros((frames, nodes, nodes, 3), np.float32)
    traction = np.zeros_like(surface)
    wrench = np.zeros((frames, 6))
    area = np.outer(*[np.convolve(np.diff(x), [0.5, 0.5])] * 2)
    for frame, tip in enumerate(scene.motion.tip):
        height = scene.indenter.heights((x - tip[0])[:, None], (x - tip[1])[None])
        deep = np.maximum(-tip[2] - height, 0.0)
        surface[frame, ..., 2] = -deep
        push = layer_force(scene, tip) or 0.0
        wrench[frame, 2] = -push
        if deep.any():
            place = np.stack([*np.meshgrid(x, x, indexing="ij"), -deep], axis=-1) - np.array(tip)
            _, normal = scene.indenter.distance(place)
            fraction = deep / -(deep * area * normal[..., 2]).sum()
            traction[frame] = push * fraction[..., None] * normal
    none = np.full(frames, np.nan)
    quality = Quality(*[none] * 10, *[np.zeros(frames, np.int64)] * 3)
    return Result(scene, "fem", wrench, x, x, surface, traction, quality, {"warnings": []})


@pytest.fixture(scope="module")
def good() -> Result:
    return _made_up(BALL)


def _broken(result: Result) -> set[str]:
    return {name for name, law in measured(result) if not law.holds}


def test_a_made_up_answer_of_the_right_size_keeps_all_laws(good: Result) -> None:
    outcome = of_laws(good, measured(good))
    assert outcome.kind == "right", outcome.why
    names = {name for name, _ in outcome.laws}
    assert {"near-layer", "within-bounds", "sums-up", "no-overlap"} <= names


@pytest.mark.parametrize(
    ("factor", "laws"),
    [
        (-1.0, {"no-pull", "touches", "within-bounds", "near-layer"}),
        (0.0, {"touches", "within-bounds", "near-layer"}),
        (5.0, {"near-layer"}),
        (30.0, {"within-bounds", "near-layer"}),
        (math.nan, {"finite"}),
    ],
)
def test_a_doctored_force_is_caught(good: Result, factor: float, laws: set[str]) -> None:
    assert laws <= _broken(replace(good, wrench=good.wrench * factor))


def _stating(result: Result, error: float) -> Result:
    stated = {"status": "estimated", "force": [error] * len(result.force), "percent": 100 * error}
    return replace(result, record={**result.record, "error": stated})


def test_forces_that_fall_with_depth_or_differ_between_twins_may_do_so_within_the_stated_error(
    good: Result,
) -> None:
    lower = good.wrench.copy()
    lower[-1] = 0.8 * lower[-2]
    falls = replace(good, wrench=lower)
    assert "rises" in _broken(_stating(falls, 0.05))
    assert "rises" not in _broken(_stating(falls, 0.2))
    twin = twin_of(BALL, "mirror-x")
    assert twin is not None
    other = replace(good, wrench=good.wrench * 1.1)
    for error, holds in ((0.0, False), (0.02, False), (0.06, True)):
        _, law = agrees(_stating(good, error), "mirror-x", twin, _stating(other, error))
        assert law.holds == holds


def _first_touch(good: Result) -> Result:
    wrench = good.wrench.copy()
    wrench[0, 2] = wrench[-1, 2] / 2
    return replace(good, wrench=wrench)


def _aside(good: Result) -> Result:
    wrench = good.wrench.copy()
    wrench[:, 0] = wrench[:, 2] / 5
    return replace(good, wrench=wrench)


def _below_the_base(good: Result) -> Result:
    surface = good.surface.copy()
    surface[-1, 0, 0, 2] = -4.1 * MM
    return replace(good, surface=surface)


def _went_through(good: Result) -> Result:
    return replace(good, surface=np.zeros_like(good.surface))


@pytest.mark.parametrize(
    ("doctored", "laws"),
    [
        (_first_touch, {"lets-go"}),
        (_aside, {"through-centre"}),
        (_went_through, {"no-overlap", "not-through"}),
        (_below_the_base, {"above-base"}),
    ],
)
def test_a_doctored_answer_is_caught(
    good: Result, doctored: Callable[[Result], Result], laws: set[str]
) -> None:
    assert laws <= _broken(doctored(good))


def test_a_blade_between_two_rows_of_nodes_is_seen() -> None:
    scene = Scene(shapes.box(0.3 * MM, 12 * MM, 0.1 * MM), press([1 * MM], at=(0.25 * MM, 0.0)))
    result = _made_up(scene)
    assert result.surface[-1].min() == 0.0  # no node is under it
    assert {"no-overlap", "not-through"} <= _broken(result)


@pytest.mark.slow
def test_skin_that_went_through_a_wall_sideways_is_caught() -> None:
    scene = Scene(shapes.box(0.6 * MM, 12 * MM, 0.1 * MM), press([0.5 * MM, 1.0 * MM]))
    result = _made_up(scene)
    rest = np.broadcast_to(result.surface_x[:, None], result.surface.shape[1:3])
    beside = np.abs(rest) < 1.0 * MM
    surface = result.surface.copy()
    for frame, side in ((1, -1.0), (2, 1.0)):
        surface[frame, ..., 0] = np.where(beside, side * 0.5 * MM - rest, 0.0)
        surface[frame, ..., 2] = 0.0
    assert "no-crossing" in _broken(replace(result, surface=surface))


def test_work_from_nowhere_and_a_force_that_depends_on_the_way_are_caught() -> None:
    way = Motion(tuple((0.0, 0.0, -z * MM) for z in (0.0, 0.3, 0.5, 0.3, 0.0)), (0, 1, 2, 3, 4))
    result = _made_up(replace(BALL, motion=way))
    assert _broken(result) == set()
    wrench = result.wrench.copy()
    wrench[3] *= 1.5
    assert {"closed-loop", "same-place"} <= _broken(replace(result, wrench=wrench))


def test_shear_beyond_friction_is_caught() -> None:
    scene = replace(BALL, indenter=shapes.sphere(8 * MM), effects=Effects(friction=Friction(0.2)))
    result = _made_up(scene)
    assert "coulomb" not in _broken(result)
    traction = result.traction.copy()
    traction[..., 0] = traction[..., 2] / 2
    assert "coulomb" in _broken(replace(result, traction=traction))


def test_a_warning_excuses_only_what_it_owns_up_to(good: Result) -> None:
    edge = "edge radius 0.2 mm is below the element's 0.6 mm: the force depends on the mesh"
    assert covered("near-layer", [edge])
    assert covered("twin-mirror-x", [edge])
    assert not covered("not-through", [edge])
    assert not covered("touches", [edge])
    assert covered("not-through", ["the skin overlaps the indenter by 0.3 mm"])
    rim = "the contact reaches the rim of the round body, which cuts through elements there"
    assert covered("lets-go", [rim])
    assert not covered("not-through", [rim])
    less = replace(good, wrench=good.wrench * 0.45, traction=good.traction * np.float32(0.45))
    message = replace(less, record={"warnings": [edge]})
    assert of_laws(message, measured(message)).kind == "warned"
    silent = replace(message, record={"warnings": []})
    assert of_laws(silent, measured(silent)).kind == "silent"


# Random scenes.


@pytest.mark.slow
def test_a_scene_is_the_same_alone_and_among_others(tmp_path: Path) -> None:
    among = [drawn(7, index, tmp_path) for index in range(12)]
    alone = drawn(7, 11, tmp_path)
    assert alone.scene == among[11].scene
    assert alone.what == among[11].what
    assert len({repr(one.scene) for one in among}) > 6
    assert drawn(8, 11, tmp_path) != alone


def test_scene_17_of_seed_0_is_what_it_was(tmp_path: Path) -> None:
    one = drawn(0, 17, tmp_path)
    assert one.what == "trap, far aside"
    assert one.scene is not None
    # If these values change, the name of every counter-example refers to a different scene.
    assert one.scene.motion.tip[1:3] == ((0.0, 0.0, -0.000584), (0.00146, 0.0, -0.000584))


@pytest.mark.slow
def test_what_is_drawn_is_a_scene_or_says_why_not_and_small_enough(tmp_path: Path) -> None:
    some = [drawn(1, index, tmp_path) for index in range(40)]
    for one in some:
        assert (one.scene is None) == (one.refusal is not None)
        assert one.refusal is None or isinstance(one.refusal, SceneError), one
    families = [one.what.split(", ")[0] for one in some]
    assert families.count("sensible") > 20
    assert {"trap", "absurd"} < set(families)
    assert sum(one.scene is None for one in some) < 15
    for one in some[:8]:
        sensible = one.what.startswith("sensible")
        if sensible and one.scene is not None and one.scene.indenter.solid is None:
            (mesh,) = meshes_of([one.scene], Fem(grading=Grading()))
            assert len(mesh.elements) <= ELEMENTS_MAX


# Twins, bounds and footprints.


@pytest.mark.slow
def test_twins_are_mirrored_in_geometry_too() -> None:
    box = shapes.box(3 * MM, 3 * MM, 0.3 * MM).tilted(0.1, 0.2)
    scene = Scene(box, press([0.5 * MM], at=(1 * MM, 2 * MM)))
    places = np.random.default_rng(0).uniform(-4 * MM, 4 * MM, (200, 3)) + np.array([0, 0, 4 * MM])
    known = {name: twin for name in KINDS if (twin := twin_of(scene, name)) is not None}
    gap, _ = scene.indenter.distance(places)
    for name, turned in (
        ("mirror-x", places * [-1, 1, 1]),
        ("mirror-y", places * [1, -1, 1]),
        ("swap-xy", places[:, [1, 0, 2]]),
    ):
        other, _ = known[name].scene.indenter.distance(turned)
        assert other == pytest.approx(gap, abs=1e-8), name
    larger, _ = known["ten-times"].scene.indenter.distance(places * 10)
    assert larger == pytest.approx(gap * 10, abs=1e-7)
    assert known["mirror-x"].scene.motion.tip[-1] == (-1 * MM, 2 * MM, -0.5 * MM)


def test_a_scene_that_is_its_own_image_has_forces_that_are(good: Result) -> None:
    assert len(symmetric(good)) == 3
    assert all(law.holds for _, law in symmetric(good))
    wrench = good.wrench.copy()
    wrench[-1, 0] = wrench[-1, 2] / 20
    holds = [law.holds for _, law in symmetric(replace(good, wrench=wrench))]
    assert holds == [False, True, False]
    aside = _made_up(Scene(shapes.box(2 * MM, 3 * MM), press([0.4 * MM], at=(1 * MM, 0.0))))
    assert len(symmetric(aside)) == 1


def test_a_bar_has_a_twin_in_a_mirror_but_none_across() -> None:
    scene = Scene(shapes.bar(2 * MM, 8 * MM), press([0.5 * MM]))
    assert twin_of(scene, "mirror-x") is not None
    assert twin_of(scene, "swap-xy") is None


def test_a_footprint_is_as_wide_as_the_sphere_there() -> None:
    raster = footprint(BALL, (0.0, 0.0, -0.4 * MM))
    assert raster.deepest == pytest.approx(0.4 * MM, rel=1e-3)
    assert raster.box is not None
    width = 2 * math.sqrt(2 * 4 * 0.4 - 0.4**2) * MM
    assert [high - low for low, high in raster.box] == pytest.approx([width] * 2, rel=0.05)
    assert half_wall(Scene(shapes.box(0.5 * MM, 12 * MM), press([MM]))) == 0.25 * MM


def test_the_layer_lies_between_the_bounds() -> None:
    tip = (0.0, 0.0, -0.4 * MM)
    layer = layer_force(BALL, tip)
    assert layer is not None
    assert least_force(BALL, tip) < layer < most_force(BALL, tip)


def test_a_ring_around_a_round_body_has_no_push_on_the_layer_either() -> None:
    ring = shapes.tube(3.3 * MM, 2.7 * MM)
    body = Body(4.5 * MM, 4.5 * MM, 2.5 * MM)
    tip = (0.0, 0.0, -0.1 * MM)
    assert layer_force(Scene(ring, press([0.1 * MM]), body), tip) is None  # at the rim
    round_body = replace(body, footprint="ellipse")
    assert layer_force(Scene(ring, press([0.1 * MM]), round_body), tip) == 0.0


def test_loading_ends_where_the_tip_goes_aside(good: Result) -> None:
    assert Reading(good).loading == [1, 2]


# Classes, shrinking and the command.


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (SceneError("body.modulus: 0; allowed: 1"), "refused"),
        (SceneError("no"), "crash"),
        (ZeroDivisionError("1/0"), "crash"),
        (SimulationDiverged("on the way to waypoint 2", ("a",)), "diverged"),
        (SimulationDiverged("no"), "crash"),
        (OutOfTime("1 s"), "timeout"),
    ],
)
def test_every_exception_has_its_class(error: Exception, kind: str) -> None:
    outcome = unsolved(error)
    assert outcome.kind == kind
    assert str(error) in outcome.message
    assert kind != "crash" or outcome.message.startswith(type(error).__name__)


def test_a_solve_is_ended_although_the_first_call_comes_within_a_destructor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Slow:
        def __del__(self) -> None:
            time.sleep(0.2)

    def solve() -> None:
        slow = Slow()
        del slow
        time.sleep(5)

    monkeypatch.setattr(processes, "AGAIN", 0.3)
    monkeypatch.setattr(sys, "unraisablehook", lambda _told: None)
    began = time.perf_counter()
    with pytest.raises(OutOfTime, match=r"within 0.05 s"), time_limit(0.05):
        solve()
    assert time.perf_counter() < began + 2


def test_a_silent_scene_is_stored_fails_the_run_and_is_on_the_page(
    good: Result,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The others are counted by class."""
    pulls = of_laws(good, measured(replace(good, wrench=-good.wrench)))

    scenes = {2: BALL, 3: LOOP}

    def judged(scene: Scene, *_settings: object) -> SceneOutcome:
        return pulls if scene is BALL else SceneOutcome("timeout", "no | answer")

    monkeypatch.setattr(judgement, "judge_scene", judged)
    monkeypatch.setattr(
        judgement, "drawn", lambda seed, index: Drawn(f"{seed}/{index}", "trap, x", scenes[index])
    )
    monkeypatch.setattr(judgement, "FOLDER", tmp_path)
    page = tmp_path / "page.md"
    options = ["--only", "random", "--first", "2", "--scenes", "2", "--processes", "1"]
    assert main(["hard-cases", *options, "--out", str(page)]) == 1
    assert "FAILED: random: 0/2: no-pull: least push" in capsys.readouterr().out
    stored = json.loads((tmp_path / "0-2.json").read_text())
    assert "no-pull" in stored["broken"]
    assert from_json(Scene, stored["scene"], "scene") == BALL
    text = page.read_text()
    assert all((law.__doc__ or "").strip() for law in LAWS.values())
    assert "| silent | laws are broken, without a warning | 1 |" in text
    assert "| no-pull | Contact does not pull," in text
    assert "| 0/3 | timeout | trap, x | no \\| answer |" in text


def test_the_command_judges_one_scene_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    options = ["--only", "random", "--first", "59", "--scenes", "1", "--processes", "1"]
    assert main(["hard-cases", *options, "--out", str(page)]) == 0
    assert "1 are refused or diverge" in page.read_text()


LOOP = Scene(
    shapes.sphere(4 * MM), press([0.3 * MM, 0.6 * MM, 0.3 * MM, 0.0]), Body(10 * MM, 10 * MM)
)
SLIDE = Scene(
    shapes.sphere(8 * MM),
    press([0.5 * MM], shear=0.5 * MM, steps=1),
    Body(16 * MM, 16 * MM),
    Effects(friction=Friction(0.2)),
)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("mistake", "scene", "law"),
    [
        ("force-scaled", LOOP, "sums-up"),
        ("frames-skipped", LOOP, "touches"),
        ("loose-tolerance", LOOP, "closed-loop"),
        ("soft-contact", LOOP, "same-place"),
        ("pushes-outwards", SLIDE, "closed-loop"),
        ("friction-doubled", SLIDE, "coulomb"),
    ],
)
def test_the_referee_notices_a_wrong_solver(mistake: str, scene: Scene, law: str) -> None:
    outcome = judge_scene(scene, "", MISTAKES[mistake].solver, 300.0)
    assert law in outcome.silent


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("scene", [LOOP, SLIDE])
def test_the_referee_accepts_the_right_solver(scene: Scene) -> None:
    outcome = judge_scene(scene, "", Solver(), 300.0)
    assert outcome.kind == "right", outcome.why
