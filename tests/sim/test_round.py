"""Round bodies and domes with a thin rim: shape, forces, and behaviour at their side."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.independent import axisymmetric
from benchmarks.independent.axisymmetric import AxisymmetricPress
from benchmarks.independent.mesh import Fine, layer_grid
from benchmarks.independent.profile import punch
from benchmarks.independent.profile import sphere as ball
from sim import Body, Effects, Friction, Layer, Motion, Result, Scene, SceneError, press, simulate
from sim.error_estimate import (
    AT_RIM,
    PER_WALL,
    fineness_of,
    further_errors,
    wall_errors,
    with_estimate,
)
from sim.fem import Fem, Grading, Precision
from sim.fem.mesh import SHARE_LEAST, build_mesh
from sim.indenters import named as catalogue
from sim.indenters import plane, sphere
from sim.markers import Camera, Pattern, Renderer, named
from sim.markers.textures import Textures
from sim.plot import surface_of
from sim.result import from_json, to_json
from sim.scene import through
from sim.tiers import simulate_many

pytestmark = pytest.mark.slow

MM = 1e-3
DISC = Body(12 * MM, 12 * MM, 4 * MM, footprint="ellipse")
DOME = Body(28 * MM, 28 * MM, 5.5 * MM, dome_radius=28.4 * MM, footprint="ellipse")
# 0.56 mm high at its rim.
THIN = replace(DOME, size_x=32 * MM, size_y=32 * MM)
BALL = sphere(2 * MM)
COARSE = Fem(spacing=1 * MM)


def _pressed(body: Body, depth: float, at: tuple[float, float] = (0.0, 0.0)) -> Result:
    return simulate(Scene(BALL, press((depth,), at=at), body))


def _push(result: Result) -> float:
    return float(-result.force[-1, 2])


# The shape.


@pytest.mark.parametrize(("size_x", "size_y"), [(12, 12), (20, 8)])
def test_shares_of_cells_are_their_area_within_the_ellipse(size_x: float, size_y: float) -> None:
    body = Body(size_x * MM, size_y * MM, footprint="ellipse")
    x = np.array([-10.0, -6.1, -3.0, 0.5, 2.0, 4.4, 5.9, 11.0]) * MM
    y = np.array([-7.0, -3.9, -1.0, 0.0, 3.0, 3.7]) * MM
    count = 400
    fine_x, fine_y = (
        (edges[:-1, None] + np.diff(edges)[:, None] * (np.arange(count) + 0.5) / count).ravel()
        for edges in (x, y)
    )
    sampled = body.covers(fine_x[:, None], fine_y).reshape(len(x) - 1, count, len(y) - 1, count)
    assert body.fractions(x, y) == pytest.approx(sampled.mean(axis=(1, 3)), abs=2e-3)
    edges = np.linspace(-10 * MM, 10 * MM, 8)
    area = float((body.fractions(edges, edges) * np.diff(edges)[0] ** 2).sum())
    assert area == pytest.approx(math.pi / 4 * body.size_x * body.size_y, rel=1e-8)


def test_a_rectangle_covers_whole_cells() -> None:
    edges = np.linspace(-10 * MM, 10 * MM, 7)
    assert (Body().fractions(edges, edges) == 1).all()


def test_the_distance_from_the_side_of_a_disc_is_exact_and_of_an_ellipse_no_more() -> None:
    place = np.array([0.0, 3.0, 6.0, 7.0]) * MM
    assert DISC.from_side(place, np.zeros(4)) == pytest.approx(6 * MM - place, abs=1e-12)
    angle = np.linspace(0, 2 * np.pi, 2000)
    ellipse = replace(DISC, size_x=20 * MM)
    outline = np.stack([10 * MM * np.cos(angle), 6 * MM * np.sin(angle)])
    for x, y in ((0.0, 0.0), (7 * MM, 2 * MM), (-9 * MM, 0.0)):
        nearest = np.hypot(outline[0] - x, outline[1] - y).min()
        assert 0 < float(ellipse.from_side(np.array(x), np.array(y))) <= nearest * (1 + 1e-6)


def test_beyond_its_rim_a_dome_goes_on_as_high_as_there() -> None:
    x = np.array([-20.0, 0.0, 14.0, 16.0, 40.0]) * MM
    heights = DOME.heights(x, x)
    assert np.isfinite(heights).all()
    assert heights[4, 4] == pytest.approx(DOME.rim - DOME.thickness)
    assert heights[0, 1] == pytest.approx(DOME.height(14 * MM, 0.0))


@pytest.mark.parametrize("diameter", [22, 28, 32])
def test_domes_of_real_sensors_are_bodies(diameter: float) -> None:
    body = replace(DOME, size_x=diameter * MM, size_y=diameter * MM)
    drop = 28.4 - math.sqrt(28.4**2 - (diameter / 2) ** 2)
    assert body.rim == pytest.approx((5.5 - drop) * MM)


def test_a_tip_may_reach_a_low_rim_and_leave_a_tenth_of_what_is_there() -> None:
    place = 15 * MM
    top = THIN.height(place, 0.0)
    here = THIN.thickness + top
    Scene(BALL, Motion(((place, 0.0, top - 0.89 * here),), (0.0,)), THIN)
    with pytest.raises(SceneError, match=r"mm deep into a body 5\.5 mm thick; allowed"):
        Scene(BALL, Motion(((place, 0.0, top - 0.91 * here),), (0.0,)), THIN)


def test_scenes_of_round_bodies_come_back_from_json_and_old_ones_are_read() -> None:
    scene = Scene(BALL, press((MM,)), DOME)
    assert from_json(Scene, to_json(scene), "scene") == scene
    square = Scene(BALL, press((MM,)), Body())
    stored = to_json(square)
    assert "footprint" not in stored["body"]
    assert from_json(Scene, stored, "scene") == square


# The mesh.


def test_elements_weigh_what_lies_within_the_footprint() -> None:
    mesh = build_mesh(DISC, 0.5 * MM)
    unit = DISC.thickness
    volume = math.pi / 4 * DISC.size_x * DISC.size_y * DISC.thickness / unit**3
    # Slivers are omitted.
    assert mesh.weight.sum() == pytest.approx(volume, rel=SHARE_LEAST**2)
    assert mesh.node_volume.sum() == pytest.approx(mesh.weight.sum())
    top = mesh.cells[0] * mesh.cells[1]
    assert 4 * mesh.face_area[:top].sum() == pytest.approx(volume, rel=SHARE_LEAST**2)
    assert (mesh.face_area[top:] == 0).all()


# The forces, against an independent solver and against laws.


def _independent(radius: float, body: Body, depth: float) -> float:
    """Return the force [N] of a sphere of `radius` [m], by second-order axisymmetric elements."""
    half, wide = body.size_x / 2, 1.2 * math.sqrt(radius * depth)
    places = [Fine(0.0, wide, wide / 8), Fine(half, half, half / 40)]
    grid = layer_grid(half, body.thickness, places, 0.3, body.dome_radius)
    layer = axisymmetric.Layer(half, body.thickness, body.modulus, body.poisson)
    path = [depth * (step / 8) ** 2 for step in range(1, 9)]
    return AxisymmetricPress(layer, ball(radius), grid, 0.0, wide).run([depth], path)[0].force


@pytest.mark.parametrize(
    ("radius", "body"),
    [(2, DISC)]
    + [pytest.param(*case, marks=pytest.mark.slow) for case in ((2, DOME), (4, DISC))]
    + [pytest.param(radius, THIN, marks=pytest.mark.slow) for radius in (2, 4)],
)
def test_forces_at_the_apex_agree_with_axisymmetric_elements(radius: float, body: Body) -> None:
    truth = _independent(radius * MM, body, 1 * MM)
    result = simulate(Scene(sphere(radius * MM), press((1 * MM,)), body))
    assert _push(result) == pytest.approx(truth, rel=0.02)
    assert result.record["error"]["status"] == "estimated"
    assert result.record["warnings"] == []
    assert result.quality.balance[-1] < 1e-3
    assert abs(result.quality.energy_gap[-1]) < 0.01


def test_a_plate_on_a_disc_comes_near_to_axisymmetric_elements_as_elements_shrink() -> None:
    grid = layer_grid(6 * MM, 4 * MM, [Fine(6 * MM, 6 * MM, 0.1 * MM)], 0.25)
    truth = AxisymmetricPress(
        axisymmetric.Layer(6 * MM, 4 * MM), punch(18 * MM, 3 * MM), grid, 0.0, 6 * MM
    )
    force = truth.run([0.2 * MM], [])[0].force
    errors = [
        _push(simulate(Scene(plane(), press((0.2 * MM,)), DISC), Fem(fineness=fine))) / force - 1
        for fine in (0.75, 1.5, 2.5)
    ]
    assert 0.03 > errors[0] > errors[1] > errors[2] > 0
    assert errors[2] < 0.01


def test_forces_beside_the_rim_settle_as_elements_shrink_there() -> None:
    scene = Scene(BALL, press((1 * MM,), at=(3 * MM, 2 * MM)), DISC)
    results = [simulate(scene, Fem(fineness=fineness)) for fineness in (0.75, 1.2, 1.8)]
    forces = [_push(result) for result in results]
    assert abs(forces[2] - forces[1]) < abs(forces[1] - forces[0])
    assert forces[0] == pytest.approx(forces[2], rel=0.02)
    beside = [np.diff(result.surface_x)[result.surface_x[:-1] > 4 * MM].min() for result in results]
    assert beside[0] > beside[1] > beside[2]


def test_a_disc_answers_alike_whichever_way_it_is_turned() -> None:
    pushes, asides = [], []
    for degrees in (0, 30):
        way = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
        result = _pressed(DISC, 1 * MM, (3.5 * MM * way[0], 3.5 * MM * way[1]))
        assert result.record["warnings"] == []
        pushes.append(_push(result))
        asides.append(result.force[-1, :2] @ way)
        across = result.force[-1, :2] @ (-way[1], way[0])
        assert abs(across) < 2e-3 * pushes[-1]
    assert pushes == pytest.approx([pushes[0]] * 2, rel=5e-3)
    assert asides == pytest.approx([asides[0]] * 2, abs=3e-3 * pushes[0])
    assert asides[0] < -0.02 * pushes[0]
    assert pushes[0] < 0.95 * _push(_pressed(DISC, 1 * MM))  # softer beside the rim


def test_a_large_ellipse_answers_as_the_rectangle_around_it_does() -> None:
    large = Body(30 * MM, 24 * MM, 2 * MM)
    both = large, replace(large, footprint="ellipse")
    scenes = [Scene(BALL, press((0.3 * MM,)), body) for body in both]
    forces = [_push(simulate(scene, Fem(fineness=0.5))) for scene in scenes]
    assert forces[1] == pytest.approx(forces[0], rel=1e-4)


def test_a_thin_rim_is_pressed_and_sheared() -> None:
    place = 12 * MM
    top = THIN.height(place, 0.0)
    low = top - 0.2 * (THIN.thickness + top)
    way = [(place, 0, top), (place, 0, low), (place, 0.3 * MM, low)]
    plain = simulate(Scene(BALL, through(way[:2], speed=10 * MM), THIN))
    assert abs(plain.quality.energy_gap[-1]) < 0.01
    motion = through(way, speed=10 * MM)
    result = simulate(Scene(BALL, motion, THIN, Effects(friction=Friction(0.5))))
    pressed, sheared = result.force[1], result.force[2]
    assert pressed[0] < 0 < -pressed[2]  # towards the apex, since the surface is inclined
    assert sheared[1] > 0.1 * -sheared[2]
    assert result.quality.residual.max() <= 1e-4
    assert result.quality.balance[1:].max() < 1e-3
    assert result.quality.det_f_min[:2].min() > 0.5
    assert result.quality.det_f_min.min() > 0.3
    assert np.nanmax(result.quality.slip_excess) < 0.02


def test_what_lies_beside_a_disc_neither_feels_nor_bends_anything() -> None:
    result = simulate(Scene(BALL, press((1 * MM,), at=(3 * MM, 0.0)), DISC), COARSE)
    x, y = result.surface_x[:, None], result.surface_y
    far = DISC.from_side(x, y) < -1.5 * MM
    assert far.any()
    assert not result.traction[:, far].any()
    corner, inside = result.surface[-1, -1, -1], result.surface[-1][DISC.covers(x, y)]
    assert corner.any()  # continues as the nearest edge
    assert np.abs(corner).max() <= np.abs(inside).max()


@pytest.mark.parametrize("precision", ["auto", "float64"])
def test_round_square_and_domed_bodies_are_solved_side_by_side_as_alone(
    precision: Precision,
) -> None:
    dome = replace(DISC, dome_radius=12 * MM)
    bodies = (DISC, replace(DISC, footprint="rectangle"), dome, replace(dome, dome_radius=15 * MM))
    scenes = [Scene(BALL, press((0.5 * MM,)), body) for body in bodies]
    numerics = replace(COARSE, grading=Grading(growth=0.0), precision=precision)
    for scene, found in zip(scenes, simulate_many(scenes, numerics), strict=True):
        assert isinstance(found, Result)
        assert found.record["environments"] == 4
        assert (found.wrench == simulate(scene, numerics).wrench).all()


# The side.


def test_a_contact_at_the_rim_has_a_wider_error() -> None:
    result = simulate(Scene(BALL, press((0.5 * MM,), at=(5.5 * MM, 0.0)), DISC), COARSE)
    within = {name: value for name, value in result.record.items() if name not in ("rim", "error")}
    plain = with_estimate(replace(result, record=within))
    error, without = plain.record["error"]["force"][-1], further_errors(plain)[-1]
    # The parts that a finer mesh may not reduce are added, then squared as one.
    further = without + AT_RIM / fineness_of(result)[-1]
    expected = np.sqrt(error**2 - without**2 + further**2)
    assert result.record["error"]["force"][-1] == pytest.approx(expected, rel=1e-3)
    assert any("rim" in warning for warning in result.record["warnings"])


def test_an_indenter_in_the_round_wall_is_never_silent() -> None:
    motion = Motion(((9 * MM, 0.0, -3 * MM), (6.6 * MM, 0.0, -3 * MM)), (0.0, 1.0))
    result = simulate(Scene(sphere(1 * MM), motion, DISC), COARSE)
    assert result.record["wall"] == [1]
    assert result.record["wall_shares"] == [1.0]  # it touches nothing else
    assert result.record["error"]["percent"] == 100
    assert any("side wall" in warning for warning in result.record["warnings"])


def test_a_wall_that_bulges_a_little_into_an_indenter_on_top_says_how_much_it_may_change() -> None:
    over = Motion(((0.0, 5.7 * MM, -1.2 * MM), (0.0, 5.3 * MM, -1.2 * MM)), (0.0, 1.0))
    scene = Scene(catalogue("random"), over, DISC, Effects(friction=Friction(0.5)))
    result = simulate(scene, Fem(fineness=0.2))
    shares = np.array(result.record["wall_shares"])
    assert 0 < shares.max() < 0.1
    assert wall_errors(result)[result.record["wall"]] == pytest.approx(PER_WALL * shares)


def test_layer_presses_a_disc_and_says_where_it_knows_nothing() -> None:
    wide = Body(20 * MM, 20 * MM, 2 * MM, footprint="ellipse")
    scene = Scene(BALL, press((0.2 * MM,)), wide)
    inside = simulate(scene, Layer())
    square = simulate(replace(scene, body=replace(wide, footprint="rectangle")), Layer())
    assert _push(inside) == pytest.approx(_push(square), rel=1e-6)
    assert inside.record["error"]["status"] == "estimated"
    diagonal = (6.2 * MM, 6.2 * MM)  # 1.2 mm from the side of the disc, 3.8 mm from the square's
    beside = simulate(Scene(BALL, press((0.2 * MM,), at=diagonal), wide), Layer())
    assert beside.record["error"]["status"] == "none"
    outside = simulate(Scene(BALL, press((0.2 * MM,), at=(8.5 * MM, 8.5 * MM)), wide), Layer())
    assert not outside.force.any()
    dome = simulate(Scene(BALL, press((0.2 * MM,)), THIN), Layer())
    assert dome.record["error"]["status"] == "none"


# The rendered view.


def test_markers_lie_on_the_round_gel() -> None:
    named("Array1").check_within(Body())
    with pytest.raises(SceneError, match=r"beyond the gel; .* 20 x 20 mm ellipse"):
        named("Array1").check_within(Body(footprint="ellipse"))


def test_what_is_seen_of_the_gel_ends_at_the_round_outline() -> None:
    bodies = Body(footprint="ellipse"), Body()
    camera = Camera.of_scale(0.08)
    axis = np.linspace(-10 * MM, 10 * MM, 5)
    still = np.zeros((1, 5, 5, 3), np.float32)
    fields = [Renderer(body, camera).displacement(axis, axis, still) for body in bodies]
    round_, square = (np.isfinite(field[0, ..., 0]) for field in fields)
    assert not (round_ & ~square).any()
    assert round_.sum() == pytest.approx(math.pi / 4 * square.sum(), rel=0.05)
    seen = [Renderer(body, camera).undeformed().material()[..., 0] for body in bodies]
    round_pixels, pixels = (int(np.isfinite(places).sum()) for places in seen)
    assert round_pixels == pytest.approx(math.pi / 4 * pixels, rel=0.01)


def test_what_a_picture_of_markers_shows_beside_the_gel_is_cut_off() -> None:
    class Everywhere(Pattern):
        def distance(self, x: np.ndarray, y: np.ndarray, band: float) -> np.ndarray:
            return np.full((len(y), len(x)), -band)

        def check_within(self, body: Body) -> None:
            pass

    everywhere = Everywhere("everywhere", "disc", 1 * MM, ((0.0, 0.0),))
    texture = Textures([everywhere], DISC, step=0.1 * MM)
    assert (texture.values.numpy() < 0).mean() == pytest.approx(math.pi / 4, rel=0.02)


def test_a_drawn_surface_ends_at_the_round_outline() -> None:
    result = simulate(Scene(BALL, press((0.5 * MM,)), DISC), COARSE)
    across = np.array([0.0, 4.1, 4.4]) * MM
    drawn = surface_of(result, -1, across)
    at = np.abs(drawn.x[:, :1] - across).argmin(axis=0)
    heights = [drawn.height[at[0], 0], drawn.height[at[1], 1], drawn.height[at[2], 2]]
    assert np.isfinite(heights).tolist() == [True, True, False]
