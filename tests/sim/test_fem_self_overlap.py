"""Self-contact of the skin: detection of folds and their depth."""

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from sim import Body, Effects, Friction, Motion, Result, Scene, SimulationDiverged, press, simulate
from sim.fem import FOR_EDGES, Fem, stepping
from sim.fem.assembly import Assembly
from sim.fem.crossing import Crossing
from sim.fem.mesh import Mesh, build_mesh
from sim.fem.self_overlap import folded_faces, self_overlap
from sim.indenters import bar, flat_punch, sphere
from sim.tiers import simulate_many

Array = NDArray[np.float64]

# A strip 6 thicknesses long whose halves are rolled up, like an overclosed book.

STRIP = Body(size_x=12e-3, size_y=4e-3, thickness=2e-3)
HALF, RADIUS = 3.0, 0.4


def _rolled(mesh: Mesh, lean: float) -> Array:
    """Return places (N, 3): a bend from the middle by 90 degrees + `lean` [rad], straight walls.

    The top is the inner side, bent along a circle of `RADIUS`.
    """
    x, y, z = mesh.nodes.T
    along, turn = np.abs(x), math.pi / 2 + lean
    angle = np.minimum(along / RADIUS, turn)
    wall = np.maximum(along - RADIUS * turn, 0.0)
    out = (RADIUS - z) * np.sin(angle) + wall * np.cos(angle)
    up = RADIUS - (RADIUS - z) * np.cos(angle) + wall * np.sin(angle)
    return np.stack([np.sign(x) * out, y, up], axis=1)


def _deepest(mesh: Mesh, places: Array, lean: float) -> float:
    """Return the depth of the right half's deepest node in the left half's straight wall."""
    nodes = np.unique(mesh.faces)
    right = places[nodes[mesh.nodes[nodes, 0] > 0]]
    along = np.array([math.sin(lean), math.cos(lean)])
    outwards = np.array([math.cos(lean), -math.sin(lean)])
    foot = np.array([-RADIUS * math.cos(lean), RADIUS + RADIUS * math.sin(lean)])
    wall = HALF - RADIUS * (math.pi / 2 + lean)
    low, deep = (right[:, [0, 2]] - foot) @ along, -(right[:, [0, 2]] - foot) @ outwards
    within = (low > 0) & (low < wall) & (deep > 0) & (deep < 1)
    ways = np.minimum(np.minimum(wall - low, deep), 1.0 - np.abs(right[:, 1]))
    return float(ways[within].max(initial=0.0))


@pytest.mark.parametrize("spacing", [0.5e-3, 0.25e-3])
def test_walls_that_lean_into_each_other_overlap_as_deep_as_they_do(spacing: float) -> None:
    mesh = build_mesh(STRIP, spacing)
    places = _rolled(mesh, math.radians(20))
    deep, node = self_overlap(mesh, places - mesh.nodes)
    assert deep == pytest.approx(_deepest(mesh, places, math.radians(20)), rel=1e-6)
    assert deep > 0.4
    assert abs(mesh.nodes[node, 0]) > 0.5 * HALF


def test_walls_that_face_each_other_do_not_overlap() -> None:
    mesh = build_mesh(STRIP, 0.25e-3)
    for lean, folds in ((-math.pi / 2, False), (math.radians(-20), False), (0.0, True)):
        places = _rolled(mesh, lean)
        assert folded_faces(mesh, places).any() == folds
        assert self_overlap(mesh, places - mesh.nodes) == (0.0, -1)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_solver_notices_folds_as_they_are(precision: Literal["float32", "float64"]) -> None:
    scene, mesh = Scene(sphere(1e-3), press([1e-4]), STRIP), build_mesh(STRIP, 0.25e-3)
    assembly = Assembly([mesh], [scene], Fem(), precision, "cpu")
    for lean in (-math.pi / 2, math.radians(-20), math.radians(-9), math.radians(-11), 0.0):
        places = _rolled(mesh, lean)
        assembly.state.u.assign((places - mesh.nodes)[None].astype(np.float32))
        found = assembly.overlap(assembly.state.everyone, samples=2)
        assert found[0, 3] == folded_faces(mesh, places).any()


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_test_on_a_gpu_says_no_only_where_nothing_overlaps(
    precision: Literal["float32", "float64"],
) -> None:
    """Walls whose ends begin to meet at 10 degrees; skin that is bent alone is let go."""
    scene, mesh = Scene(sphere(1e-3), press([1e-4]), STRIP), build_mesh(STRIP, 0.4e-3)
    assembly = Assembly([mesh] * 2, [scene] * 2, Fem(), precision, "cpu")
    assembly.crossing = Crossing(assembly.real, 2, mesh.faces, "cpu")
    looked, overlaps = [], []
    for degrees in (-9, 8, 10, 14):
        u = _rolled(mesh, math.radians(degrees)) - mesh.nodes
        # The second environment is at rest.
        assembly.state.u.assign(np.stack([u, 0 * u]).astype(np.float32))
        found = assembly.overlap(assembly.state.everyone, samples=2)
        assert found[1, 3] == 0.0
        looked.append(bool(found[0, 3]))
        overlaps.append(self_overlap(mesh, u)[1] >= 0)
    assert all(look for look, crossed in zip(looked, overlaps, strict=True) if crossed)
    assert any(overlaps)
    assert not any(looked[:2])


def test_a_lip_folded_over_onto_flat_skin_overlaps_it() -> None:
    """The right half is rolled by half a turn, its end 0.05 thicknesses deep in the left half."""
    mesh = build_mesh(STRIP, 0.25e-3)
    x, y, z = mesh.nodes.T
    angle = np.clip(x / RADIUS, 0.0, math.pi)
    beyond = np.maximum(x - RADIUS * math.pi, 0.0)
    out = np.minimum(x, 0.0) + (RADIUS - z) * np.sin(angle) - beyond
    up = np.where(beyond > 0, -0.05 - z, RADIUS - (RADIUS - z) * np.cos(angle))
    deep, _node = self_overlap(mesh, np.stack([out, y, up], axis=1) - mesh.nodes)
    assert deep == pytest.approx(0.05, rel=1e-6)


# Simulated presses.

SMALL = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)


def test_what_lies_beside_a_round_body_is_no_skin_to_overlap() -> None:
    """Nodes outside stay where they were; the body's are pushed down and away from its middle."""
    disc = Body(size_x=8e-3, size_y=8e-3, thickness=2e-3, footprint="ellipse")
    mesh = build_mesh(disc, 0.4e-3)
    moves = mesh.node_volume > 0
    height = 1.0 + mesh.nodes[:, 2]
    u = (
        mesh.nodes * [0.2, 0.2, 0.0] * height[:, None]
        + np.array([0.0, 0.0, -0.4]) * height[:, None]
    )
    assert self_overlap(mesh, np.where(moves[:, None], u, 0.0)) == (0.0, -1)


def test_a_leap_through_the_indenter_is_tried_in_shorter_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The measured overlap along the way is replaced: in the first step of the press, then in all.

    It is half the thickness; the tip moves an eighth of it.
    """
    scene = Scene(sphere(3e-3), press([0.5e-3]), SMALL)
    numerics = Fem(spacing=4e-3 / 3)
    plain = simulate(scene, numerics)
    overlap, leaps = Assembly.overlap, [0.0, 0.5]

    def leapt(assembly: Assembly, *given: Any, **named: Any) -> Array:
        found = overlap(assembly, *given, **named)
        if named.get("states", 1) > 1 and leaps:  # the way, not its end
            found[:, 0] += leaps.pop(0)
        return found

    monkeypatch.setattr(Assembly, "overlap", leapt)
    result = simulate(scene, numerics)
    assert not leaps
    assert result.quality.steps.tolist() == [plain.quality.steps[0], plain.quality.steps[1] + 2]
    assert result.force[1, 2] == pytest.approx(plain.force[1, 2], rel=1e-3)
    leaps[:] = [0.5] * 100
    with pytest.raises(SimulationDiverged, match=r"leaps through the indenter: .* um") as told:
        simulate(scene, numerics)
    assert all("leaps through the indenter" in one for one in told.value.tried)


def test_energy_that_nobody_has_given_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """The measured work is replaced: a tenth less than was done, then a thirtieth."""
    scene = Scene(sphere(3e-3), press([0.5e-3]), SMALL)
    work = Assembly.work
    for fraction, count in ((0.9, 1), (0.97, 0)):
        with monkeypatch.context() as less:
            less.setattr(Assembly, "work", lambda *given, f=fraction: f * work(*given))
            result = simulate(scene, Fem(spacing=4e-3 / 3, step_travel=0.05e-3))
        found = [one for one in result.record["warnings"] if "more energy than the indenter" in one]
        assert len(found) == count


def test_skin_that_leaps_far_is_followed_closely_enough_to_meet_a_thin_bar() -> None:
    """From 0.5 mm below a lying bar of 0.2 mm to 0.5 mm above it, by faces of 0.25 mm."""
    scene, mesh = Scene(bar(1e-4, 4e-3), press([1e-4]), STRIP), build_mesh(STRIP, 0.25e-3)
    assembly = Assembly([mesh], [scene], Fem(), "float64", "cpu")
    state, unit = assembly.state, STRIP.thickness
    state.start(np.array([[0.0, 0.0, -0.4e-3]]) / unit)
    up = np.array([0.0, 0.0, 1e-3]) / unit
    state.contact.u_old.assign(np.tile(-0.9 * up, (1, len(mesh.nodes), 1)))
    state.u.assign(np.tile(0.3 * up, (1, len(mesh.nodes), 1)))
    assert assembly.overlap(state.everyone, samples=3)[0, 0] == 0.0
    found = assembly.overlap(state.everyone, samples=3, states=3)[0, 0] * unit
    assert 0.05e-3 < found < 0.11e-3


@pytest.mark.slow
def test_a_deep_press_and_shear_turns_the_skin_but_does_not_fold_it() -> None:
    motion = Motion(((0.0, 0.0, -1.5e-3), (0.8e-3, 0.0, -1.5e-3)), (0.0, 0.1))
    scene = Scene(sphere(2e-3), motion, SMALL, Effects(friction=Friction(0.8)))
    result = simulate(scene, Fem(spacing=4e-3 / 5))
    assert result.record["self_overlap"] == {"metres": [0.0, 0.0]}


@pytest.fixture
def folding(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Return a function after which every state is folded, by this depth [thicknesses]."""
    overlap = Assembly.overlap

    def folded(assembly: Assembly, *given: Any, **named: Any) -> Array:
        found = overlap(assembly, *given, **named)
        found[:, 3] = 1.0
        return found

    def fold(depth: float) -> None:
        monkeypatch.setattr(Assembly, "overlap", folded)
        monkeypatch.setattr("sim.fem.self_overlap.self_overlap", lambda *_given: (depth, 10))

    return fold


def test_what_folds_is_a_warning_or_no_result(folding: Callable[[float], None]) -> None:
    """By 5 % of the contact width, then by 30 %."""
    scene = Scene(sphere(3e-3), press([0.5e-3]), SMALL)
    depth = 0.5e-3 / SMALL.thickness
    folding(0.05 * depth)
    result = simulate(scene, Fem(spacing=4e-3 / 3))
    assert result.record["self_overlap"]["metres"][1] == pytest.approx(25e-6)
    message = "25 um inside the skin beside it at waypoint 1, 5 %"
    assert [one for one in result.record["warnings"] if message in one]
    folding(0.3 * depth)
    with pytest.raises(SimulationDiverged, match=r"folds and passes through itself: .*150 um"):
        simulate(scene, Fem(spacing=4e-3 / 3))


def test_a_fold_above_the_limit_ends_the_path_where_it_grows(
    folding: Callable[[float], None],
) -> None:
    """Large in every state; shorter steps are tried first."""
    folding(0.2)
    with pytest.raises(SimulationDiverged, match=r"folds and passes through itself") as caught:
        simulate(Scene(sphere(3e-3), press([0.3e-3, 0.6e-3]), SMALL), Fem(spacing=4e-3 / 3))
    assert len(caught.value.tried) <= 3
    assert all("overlaps itself" in one for one in caught.value.tried)


@pytest.mark.slow
def test_the_host_computes_the_same_in_threads_beside_a_gpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenes = [
        Scene(flat_punch(radius, 0.2e-3), press([1.5e-3]), effects=Effects(friction=Friction(0.8)))
        for radius in (2e-3, 3e-3)
    ]
    folds = []
    real = stepping.on_host

    def on_host(_device: str, *given: Any) -> list[Any]:
        found = real("cuda:0", *given)
        folds.extend(one for one in found if isinstance(one, tuple))
        return found

    fem = Fem(spacing=1e-3, grading=FOR_EDGES, tolerance=0.015, path_tolerance=0.1, augmentations=1)
    plain = simulate_many(scenes, fem)
    monkeypatch.setattr(stepping, "on_host", on_host)
    beside = simulate_many(scenes, fem)
    assert folds
    for one, other in zip(plain, beside, strict=True):
        assert isinstance(one, Result)
        assert isinstance(other, Result)
        np.testing.assert_array_equal(one.force, other.force)
        np.testing.assert_array_equal(one.quality.contact_width, other.quality.contact_width)
        assert {**one.record, "seconds": 0} == {**other.record, "seconds": 0}
