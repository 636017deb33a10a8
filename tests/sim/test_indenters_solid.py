"""Indenters from STL files: compared with exact shapes, and stored and read as values."""

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from support import stl_files as files

from sim.errors import SceneError
from sim.indenters import (
    NAMES,
    Indenter,
    assembled,
    box,
    from_stl,
    named,
    rounded_cone,
    sphere,
    tube,
)
from sim.indenters.solid import Field, NodeGrid, coefficients, level_surface
from sim.result import from_json, to_json
from sim.scene import Scene, press

Array = NDArray[np.float64]

SPACING = 0.15e-3
EDGE = 0.4e-3
Make = Callable[..., Indenter]


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Make:
    folder = tmp_path_factory.mktemp("stl")

    def made(name: str, body: files.Body, edge_radius: float = EDGE, **options: object) -> Indenter:
        path = files.write_binary(folder / f"{name}.stl", body)
        given = {"spacing": SPACING, "reach": 2.5e-3, **options}
        return from_stl(path, edge_radius=edge_radius, **given)  # type: ignore[arg-type]

    return made


def _near(exact: Indenter, count: int = 30000) -> tuple[Array, Array, Array]:
    """Return points 0.3 mm outside to 0.05 mm inside the lower surface, with gaps and normals."""
    sides = np.clip(np.array(exact.bounds), -4e-3, 4e-3)
    low, high = sides[:, 0] - 0.4e-3, sides[:, 1] + 0.4e-3
    high[2] = 2.2e-3
    points = np.random.default_rng(3).uniform(low, high, (count, 3))
    gap, normal = exact.distance(points)
    near = (gap > -0.05e-3) & (gap < 0.3e-3)
    assert near.sum() > 1000
    return points[near], gap[near], normal[near]


def _errors(found: Indenter, exact: Indenter) -> tuple[Array, Array]:
    """Return the errors of the gap [m] and of the normal [rad]."""
    points, gap, normal = _near(exact)
    other, other_normal = found.distance(points)
    np.testing.assert_allclose(np.linalg.norm(other_normal, axis=1), 1, atol=1e-12)
    return np.abs(other - gap), 2 * np.arcsin(np.linalg.norm(normal - other_normal, axis=1) / 2)


@pytest.mark.parametrize(
    ("body", "edge_radius", "exact", "most", "typical", "turned", "turned_most"),
    [
        # The file's chords are up to 0.9 um inside the sphere, and tilted by up to 1.6 degrees.
        pytest.param(
            files.ball(1.5, 31), 0.0, sphere(1.5e-3), 1.5, 1.5, 1.0, 1.0, marks=pytest.mark.slow
        ),
        (files.block(3, 4, 5), EDGE, box(3e-3, 4e-3, EDGE), 5, 0.7, 0.6, 6),
        (files.rounded_block(3, 4, 5, 0.4, 21), 0.0, box(3e-3, 4e-3, EDGE), 5, 5, 0.7, 90),
        (
            files.revolved([(2.5, 0), (2.5, 4), (1.5, 4), (1.5, 0)], 120),
            EDGE,
            tube(2.5e-3, 1.5e-3, EDGE),
            15,
            1.5,
            1.5,
            90,
        ),
    ],
    ids=["fine sphere", "sharp block, rounded", "block drawn round", "tube with its hole"],
)
def test_bodies_are_like_the_exact_ones(
    make: Make,
    body: files.Body,
    edge_radius: float,
    exact: Indenter,
    most: float,
    typical: float,
    turned: float,
    turned_most: float,
) -> None:
    """Errors of the gap [um] and of the normal [deg], the largest and their root mean squares."""
    solid = make("body", body, edge_radius)
    gap, turn = _errors(solid, exact)
    assert 1e6 * gap.max() < most
    assert 1e6 * np.sqrt(np.mean(gap**2)) < typical
    assert np.degrees(np.sqrt(np.mean(turn**2))) < turned
    assert np.degrees(turn).max() < turned_most
    assert solid.solid is not None
    assert solid.solid.notes == ()


def test_a_pointed_tip_becomes_round_and_its_lowest_point_the_origin(make: Make) -> None:
    # As seen from the axis at 45 degrees: a cone of 4 mm on a cylinder.
    body = files.revolved([(0, 0), (3, 3), (3, 5), (0, 5)], 120)
    found, exact = make("cone", body), rounded_cone(np.pi / 4, EDGE)
    gap, _ = _errors(found, exact)
    assert gap.max() < 20e-6
    assert found.solid is not None
    (note,) = found.solid.notes
    assert note == f"rounding cone.stl to 0.4 mm took {0.4 * (2**0.5 - 1):.3g} mm off its tip"
    assert abs(float(found.heights(0.0, 0.0))) < 5e-6


def test_heights_are_where_the_distance_first_becomes_zero(make: Make) -> None:
    found = make("block", files.block(3, 4, 5))
    x, y = np.random.default_rng(1).uniform(-2e-3, 2e-3, (2, 500))
    heights = found.heights(x, y, reach=2e-3)
    hit = np.isfinite(heights)
    assert 100 < hit.sum() < 450
    gap, _ = found.distance(np.column_stack([x[hit], y[hit], heights[hit]]))
    assert np.abs(gap[heights[hit] > 0]).max() < 1e-9
    # Where a face meets an edge the spline undershoots the tip plane slightly.
    assert np.abs(gap).max() < 2e-6
    np.testing.assert_allclose(heights, box(3e-3, 4e-3, EDGE).heights(x, y, reach=2e-3), atol=40e-6)


def test_bounds_hold_the_body_and_end_where_it_does_and_its_edge_is_known(make: Make) -> None:
    block = make("block", files.block(3, 4, 5))
    assert block.sharpest == pytest.approx(EDGE)
    x, y, z = block.bounds
    np.testing.assert_allclose([x, y], [(-1.5e-3, 1.5e-3), (-2e-3, 2e-3)], atol=1e-9)
    assert z == (0.0, np.inf)
    assert make("low", files.block(3, 4, 2)).bounds[2] == pytest.approx((0.0, 2e-3), abs=1e-8)


def test_beyond_the_grid_the_distance_goes_on_and_above_it_the_body_does(make: Make) -> None:
    found = make("block", files.block(3, 4, 5))
    gap, normal = found.distance([(0.3e-3, 0, -4e-3), (9e-3, 0, 1e-3), (0, 0, 4e-3)])
    np.testing.assert_allclose(gap[:2], [4e-3, 7.5e-3], rtol=1e-3)
    np.testing.assert_allclose(normal[:2], [(0, 0, -1), (1, 0, 0)], atol=0.02)
    assert gap[2] < -1e-3
    outside, _ = found.distance([(1.7e-3, 0, 20e-3), (1.4e-3, 0, 20e-3)])
    np.testing.assert_allclose(outside, [0.2e-3, -0.1e-3], atol=5e-6)


def test_a_field_is_the_spline_of_scipy_and_its_normal_the_gradient() -> None:
    grid = NodeGrid((-4, -5, -6), (9, 11, 13), 1e-3)
    place = grid.points().reshape(*grid.shape, 3)
    values = np.linalg.norm(place - [0.3e-3, 0.1e-3, -0.2e-3], axis=-1) - 2e-3
    field = Field(grid, coefficients(values), 0.5e-3, ((-1.0, 1.0),) * 3)
    points = np.random.default_rng(0).uniform(-2.4e-3, 1.9e-3, (300, 3))
    gap, normal = field.distance(points)
    nodes = (points + np.array([0, 0, 0.5e-3])) / grid.spacing - grid.first
    expected = map_coordinates(values, nodes.T, order=3, mode="mirror")
    np.testing.assert_allclose(gap, expected, atol=1e-15)
    step = 1e-8
    ahead, behind = (
        np.stack([field.distance(points + side * step * axis)[0] for axis in np.eye(3)], axis=1)
        for side in (1, -1)
    )
    gradient = (ahead - behind) / (2 * step)
    gradient /= np.linalg.norm(gradient, axis=1)[:, None]
    np.testing.assert_allclose(normal, gradient, atol=1e-6)


def test_the_surface_at_a_level_keeps_planes_edges_and_corners_exactly() -> None:
    grid = NodeGrid((-12, -12, -12), (25, 25, 25), 0.1e-3)
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    half = np.array([0.5e-3, 0.6e-3, 0.7e-3])

    def nearest_face(points: Array) -> tuple[Array, Array]:
        beyond = np.abs(points @ turn) - half
        face = beyond.argmax(axis=1)
        sign = np.sign(points @ turn)
        return beyond.max(axis=1), (np.eye(3)[face] * sign) @ turn.T

    values = nearest_face(grid.points())[0].reshape(grid.shape)
    vertices, faces = level_surface(values, grid, nearest_face)
    assert np.abs(nearest_face(vertices)[0]).max() < 1e-15
    # Every corner of the box is a vertex.
    corners = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * half
    away = np.linalg.norm(vertices[:, None] - (corners @ turn.T)[None], axis=-1)
    assert away.min(axis=0).max() < 1e-12
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(8 * (half * np.roll(half, 1)).sum(), rel=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"edge_radius": 0.2e-3}, r"edge_radius: 0\.0002 m of block\.stl; allowed: 0, or from"),
        ({"edge_radius": 1.6e-3}, r"edge_radius: 0\.0016 m leaves nothing of block\.stl"),
        ({"edge_radius": np.nan}, r"indenter block\.edge_radius: nan m"),
        ({"edge_radius": -1e-3}, r"indenter block\.edge_radius: -0\.001 m"),
        ({"unit": "foot"}, "solid.unit: 'foot'; allowed: 'um', 'mm', 'cm'"),
        ({"up": "z"}, "solid.up: 'z'; allowed: "),
        ({"axis": "left"}, "solid.axis: 'left'; allowed: 'middle', 'file'"),
        ({"spacing": 0.0}, "solid.spacing: 0.0 m; allowed: 5e-06 to 0.001 m"),
        ({"spacing": 10e-6}, r"solid.spacing: 1e-05 m makes [\d,]+ nodes; allowed: up to 16,000"),
        ({"reach": np.inf}, "solid.reach: inf m"),
        ({"unit": "m"}, "5000 mm long, read in m"),
    ],
)
def test_what_the_grid_or_the_body_has_no_room_for_is_refused(
    options: dict[str, object], message: str, make: Make
) -> None:
    given = {"edge_radius": EDGE, **options}
    with pytest.raises(SceneError, match=message):
        make("block", files.block(3, 4, 5), **given)


def test_a_wall_that_rounding_would_lose_is_refused(make: Make) -> None:
    rim = [(1, 0), (1.6, 0), (1.6, 3), (2, 3), (2, 5), (0, 5), (0, 3), (1, 3)]
    with pytest.raises(SceneError, match="does not separate inside from outside"):
        make("overlap", files.joined(files.block(1, 3, 4), files.block(3, 1, 4)))
    with pytest.raises(SceneError, match=r"edge_radius: 0.0004 m takes 0\.00\d+ m off rim.stl"):
        make("rim", files.revolved(rim, 60), reach=4e-3)


@pytest.mark.parametrize(
    ("thick", "edge_radius", "rounded", "note"),
    [(0.5, 0.3e-3, 0.3e-3, "removes parts up to 0.5"), (0.2, None, 0.05e-3, None)],
)
def test_edges_leave_thin_parts_or_their_size_is_said(
    thick: float, edge_radius: float | None, rounded: float, note: str | None, tmp_path: Path
) -> None:
    """Pins before a plate, in inches."""
    pins = [files.moved(files.block(thick, thick, 0.8), (2 * i, 0, 0)) for i in (-1, 0, 1)]
    vertices, faces = files.joined(*pins, files.moved(files.block(5, 1, 4), (0, 0, 0.82)))
    path = files.write_binary(tmp_path / "pins.stl", (vertices / 25.4, faces))
    found = from_stl(path, unit="inch", edge_radius=edge_radius, reach=1e-3)
    assert found.solid is not None
    assert found.edge_radius == pytest.approx(rounded)
    assert any(note in one for one in found.solid.notes) if note else not found.solid.notes
    low = found.heights([-2e-3, 0, 2e-3, 1e-3], 0.0, reach=1e-3)
    np.testing.assert_allclose(low, [0, 0, 0, 0 if note else 0.82e-3], atol=20e-6)


def test_a_scene_keeps_the_file_by_its_content(make: Make, tmp_path: Path) -> None:
    found = make("block", files.block(3, 4, 5))
    scene = Scene(found, press([0.5e-3]))
    stored = json.loads(json.dumps(to_json(scene), allow_nan=False))
    again = from_json(Scene, stored, "scene")
    assert again == scene
    assert again.indenter.solid is not None
    assert found.solid is not None
    assert again.indenter.solid.path == found.solid.path
    assert pickle.loads(pickle.dumps(scene)) == scene
    # Only its content matters, not its path.
    copy = tmp_path / "copy.stl"
    copy.write_bytes(Path(found.solid.path).read_bytes())
    assert replace(found, solid=replace(found.solid, path=str(copy))) == found
    assert replace(found, solid=replace(found.solid, sha256="0" * 64)) != found
    points = np.random.default_rng(0).uniform(-2e-3, 2e-3, (50, 3))
    np.testing.assert_array_equal(again.indenter.distance(points)[0], found.distance(points)[0])


def test_a_file_that_has_gone_or_changed_is_told_of_only_when_it_is_needed(
    make: Make, tmp_path: Path
) -> None:
    path = files.write_binary(tmp_path / "tip.stl", files.block(2, 2.5, 3))
    found = from_stl(path, edge_radius=EDGE, spacing=SPACING, reach=2e-3)
    stored = to_json(Scene(found, press([0.5e-3])))
    # As if in a new process that has not read it yet.
    for name, at in (("changed", path), ("gone", tmp_path / "gone.stl")):
        stored["indenter"]["solid"].update(path=str(at), axis="file")
        if name == "changed":
            files.write_binary(path, files.block(2, 2.5, 3.1))
        again = from_json(Scene, stored, "scene")
        message = "has changed, its SHA-256 is" if name == "changed" else "no such file"
        with pytest.raises(
            SceneError, match=f"solid.path: .*{message}.*allowed: the file with SHA"
        ):
            again.indenter.distance([(0, 0, 0)])
    with pytest.raises(FileNotFoundError):
        from_stl(tmp_path / "never.stl")


def test_a_press_goes_no_deeper_than_the_body_is_known(make: Make) -> None:
    found = make("block", files.block(3, 4, 5))
    assert Scene(found, press([2.5e-3])).indenter == found
    with pytest.raises(SceneError, match=r"2\.6 mm deep with an indenter known up to 2\.5 mm"):
        Scene(found, press([2.6e-3]))


def test_parts_and_a_solid_do_not_go_together(make: Make) -> None:
    found = make("block", files.block(3, 4, 5))
    with pytest.raises(SceneError, match="parts and a solid; allowed: either"):
        replace(found, parts=sphere(1e-3).parts)


@pytest.mark.parametrize("name", NAMES)
def test_a_named_shape_as_a_part_has_its_surface_where_it_is_put(name: str) -> None:
    text = f"parts: [{{shape: {name}, position_mm: [1, 2, 3], turn_deg: [0, 0, 30]}}]"
    corners, faces = assembled(text.encode(), "x.yaml")
    turn = Rotation.from_rotvec([0, 0, np.pi / 6])
    corners = turn.apply(1e-3 * (corners - [1, 2, 3]), inverse=True)
    middles = corners[faces].mean(axis=1)
    for points, most in ((corners, 1e-9), (middles, 0.03e-3)):
        gap = named(name, 0.0).distance(points[points[:, 2] < 9.9e-3])[0]
        assert np.abs(gap).max() < most


def test_parts_are_one_body_of_the_volume_of_their_union(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(
        "parts:\n"
        "- {shape: box, size_mm: [4, 4, 2], position_mm: [0, 0, 1]}\n"
        "- {shape: box, size_mm: [4, 4, 2], position_mm: [0, 0, 3]}\n"
        "- {shape: cylinder, radius_mm: 1, height_mm: 9}\n"
    )
    body = from_stl(path, edge_radius=0.0)
    corners, faces = body.solid.triangles().vertices, body.solid.triangles().faces
    a, b, c = np.moveaxis(corners[faces], 1, 0)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx((64 + 5 * np.pi) * 1e-9, rel=1e-3)
    assert body.bounds[2][0] == 0.0
    # A wall over the joint is no edge, and the tip is that of the cylinder.
    assert body.distance([2.1e-3, 0.0, 3e-3])[0] == pytest.approx(0.1e-3, abs=2e-6)
    assert body.heights(0.0, [0.0, 1.5e-3])[1] == pytest.approx(1e-3, abs=2e-6)
