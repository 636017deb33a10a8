import itertools

import numpy as np
import pytest
from support import fem_oracles as oracle

from sim import Body
from sim.fem import Grading
from sim.fem.mesh import MANY, MULTIPLE, Mesh, axis, build_mesh

FLAT = Body(size_x=6e-3, size_y=5e-3, thickness=3e-3)
DOMED = Body(size_x=6e-3, size_y=6e-3, thickness=3e-3, dome_radius=9e-3)
GROWTH, COARSEST = Grading().growth, Grading().coarsest
WINDOWS = [(-1e-3, 1e-3), (2e-3, 5e-3), (-10e-3, -9e-3), (-10e-3, 10e-3), (0.31e-3, 0.31e-3)]


EVEN = build_mesh(FLAT, 1e-3)
DOME = build_mesh(DOMED, 1e-3)
# Finer than `COARSEST` in the middle, up to 3 times as wide outside.
GRADED = build_mesh(FLAT, 0.25e-3, ((-0.5e-3, 0.5e-3), (0.0, 1e-3)))
OF_FLAT = pytest.mark.parametrize("mesh", [EVEN, GRADED], ids=["even", "graded"])
ANY = pytest.mark.parametrize("mesh", [EVEN, GRADED, DOME], ids=["even", "graded", "domed"])


@ANY
def test_inverse_jacobians_and_volumes_are_numpys(mesh: Mesh) -> None:
    expected = oracle.with_nodes(mesh, mesh.nodes)
    np.testing.assert_allclose(mesh.weight, expected.weight, rtol=1e-11)
    size = np.abs(expected.inverse).max()
    np.testing.assert_allclose(mesh.inverse, expected.inverse, atol=1e-12 * size)


@ANY
def test_volumes_of_nodes_and_areas_of_faces_are_the_elements(mesh: Mesh) -> None:
    eighth = np.repeat(mesh.weight.sum(axis=1) / 8, 8)
    expected = np.bincount(mesh.elements.ravel(), eighth, len(mesh.nodes))
    np.testing.assert_allclose(mesh.node_volume, expected, rtol=1e-11)
    corners = mesh.nodes[mesh.faces]
    one, other = corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1]
    area = np.linalg.norm(np.cross(one, other), axis=1) / 2
    # A dome's faces are two triangles that are not exactly coplanar.
    np.testing.assert_allclose(4 * mesh.face_area, area, rtol=1e-3 if mesh is DOME else 1e-11)


def test_elements_of_one_size_fill_the_body_as_asked() -> None:
    mesh = EVEN
    assert mesh.cells == (6, 5, 3)
    assert mesh.finest == pytest.approx(1 / 3)


@OF_FLAT
def test_volumes_and_areas_are_the_bodys(mesh: Mesh) -> None:
    unit = FLAT.thickness
    volume = FLAT.size_x * FLAT.size_y * FLAT.thickness / unit**3
    assert mesh.weight.sum() == pytest.approx(volume)
    assert mesh.node_volume.sum() == pytest.approx(volume)
    sides = 2 * (FLAT.size_x + FLAT.size_y) * FLAT.thickness + FLAT.size_x * FLAT.size_y
    assert 4 * mesh.face_area.sum() == pytest.approx(sides / unit**2)
    assert (mesh.weight > 0).all()


@pytest.mark.slow
def test_a_domes_volume_comes_close_to_the_integral_of_its_height() -> None:
    x, y = np.meshgrid(*[np.linspace(-3e-3, 3e-3, 400)] * 2)
    depth = DOMED.thickness + np.mean(
        [DOMED.height(float(a), float(b)) for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    )
    exact = depth * DOMED.size_x * DOMED.size_y / DOMED.thickness**3
    errors = [
        abs(build_mesh(DOMED, spacing).weight.sum() / exact - 1) for spacing in (1e-3, 0.5e-3)
    ]
    assert errors[0] < 0.01
    assert errors[1] < errors[0]
    assert DOME.nodes[DOME.top[3, 3]] == pytest.approx([0, 0, 0], abs=1e-12)


@OF_FLAT
def test_nodes_know_the_elements_and_faces_around_them(mesh: Mesh) -> None:
    for around, cells in ((mesh.node_elements, mesh.elements), (mesh.node_faces, mesh.faces)):
        corners = cells.shape[1]
        listed = around[around >= 0]
        assert sorted(listed) == list(range(cells.size)), "every corner of every cell once"
        for node, row in enumerate(around):
            for place in row[row >= 0]:
                assert cells[place // corners, place % corners] == node


@OF_FLAT
def test_x_and_y_say_where_the_columns_of_nodes_stand(mesh: Mesh) -> None:
    place = mesh.nodes.reshape(len(mesh.x), len(mesh.y), -1, 3)
    assert np.ptp(place[..., 0] - mesh.x[:, None, None]) == 0
    assert np.ptp(place[..., 1] - mesh.y[None, :, None]) == 0
    assert [len(mesh.x), len(mesh.y), place.shape[2]] == [count + 1 for count in mesh.cells]
    assert mesh.x[[0, -1]] * FLAT.thickness == pytest.approx([-3e-3, 3e-3])
    assert mesh.y[[0, -1]] * FLAT.thickness == pytest.approx([-2.5e-3, 2.5e-3])


def test_a_graded_mesh_is_fine_in_its_window_and_has_fewer_elements_for_it() -> None:
    wide = Body(size_x=20e-3, size_y=16e-3, thickness=3e-3)
    window = ((-0.5e-3, 0.5e-3), (4e-3, 5e-3))
    mesh, even = build_mesh(wide, 0.25e-3, window), build_mesh(wide, 0.25e-3)
    assert mesh.cells[2] == even.cells[2]
    assert len(mesh.elements) < len(even.elements) / 3
    assert mesh.finest == pytest.approx(even.finest, rel=0.2)
    assert mesh.finest <= even.finest
    assert max(np.diff(mesh.x).max(), np.diff(mesh.y).max()) > 2 * even.finest


def test_elements_wider_than_the_coarsest_are_not_graded() -> None:
    """Grading would gain nothing; the window may be anywhere."""
    spacing = 1.01 * COARSEST * FLAT.thickness
    meshes = [build_mesh(FLAT, spacing, (window, window)) for window in WINDOWS]
    for mesh in meshes:
        np.testing.assert_allclose(np.diff(mesh.x), mesh.x[1] - mesh.x[0], rtol=1e-6)
        np.testing.assert_array_equal(mesh.nodes, meshes[0].nodes)


@pytest.mark.parametrize("spacing", [0.13e-3, 0.3e-3, 0.7e-3, 2e-3])
@pytest.mark.parametrize("window", WINDOWS)
def test_an_axis_is_as_fine_as_asked_in_its_window_and_grows_slowly_outside(
    window: tuple[float, float], spacing: float
) -> None:
    size, coarsest = 20e-3, 1e-3
    places = axis(size, spacing, window, coarsest, GROWTH)
    lengths = np.diff(places)
    assert places[[0, -1]].tolist() == [-size / 2, size / 2]
    multiple = MULTIPLE if len(lengths) <= MANY else 2 * MULTIPLE
    assert len(lengths) % multiple == 0
    assert (lengths > 0).all()
    inside = (places[1:] > window[0]) & (places[:-1] < window[1])
    assert inside.any()
    # An element half inside the window may be longer, according to its distance outside.
    within = inside & (places[:-1] >= window[0]) & (places[1:] <= window[1])
    assert (lengths[within] <= spacing * (1 + 1e-3)).all()
    assert (lengths[inside] <= spacing * np.exp(GROWTH)).all()
    assert lengths.max() <= max(coarsest, spacing) * (1 + 1e-3)
    # Length grows by GROWTH per distance, hence by at most exp(GROWTH) between neighbours.
    ratio = lengths[1:] / lengths[:-1]
    assert np.maximum(ratio, 1 / ratio).max() <= np.exp(GROWTH) * (1 + 1e-3)
    away = np.maximum(np.maximum(window[0] - places[1:], places[:-1] - window[1]), 0)
    asked = np.minimum(spacing + GROWTH * (away + lengths), max(coarsest, spacing))
    assert (lengths <= asked * (1 + 1e-3)).all()
    # Nor much finer than that: rounding up adds less than a multiple.
    least = np.minimum(spacing + GROWTH * away, max(coarsest, spacing))
    shrunk = (len(lengths) - multiple) / len(lengths)
    assert (lengths >= least * shrunk * (1 - 1e-3)).all()


def test_an_axis_about_a_window_in_the_middle_is_its_own_mirror_image() -> None:
    places = axis(20e-3, 0.3e-3, (-2e-3, 2e-3), 1e-3, GROWTH)
    np.testing.assert_allclose(places, -places[::-1], atol=1e-15)
    one, other = (
        axis(20e-3, 0.3e-3, window, 1e-3, GROWTH) for window in ((1e-3, 4e-3), (-4e-3, -1e-3))
    )
    np.testing.assert_allclose(one, -other[::-1], atol=1e-15)


def test_only_the_base_is_held_and_only_it_is_not_a_face() -> None:
    mesh = EVEN
    np.testing.assert_array_equal(~mesh.free, mesh.nodes[:, 2] == -1)
    assert not (mesh.nodes[mesh.faces][:, :, 2] == -1).all(axis=1).any()
    boundary = np.bincount(mesh.faces.ravel(), minlength=len(mesh.nodes)) > 0
    inside = (
        (np.abs(mesh.nodes[:, 0]) < 0.999)
        & (np.abs(mesh.nodes[:, 1]) < 0.83)
        & (mesh.nodes[:, 2] < -1e-9)
        & mesh.free
    )
    assert not (boundary & inside).any()


def test_the_mesh_is_a_mirror_image_of_itself() -> None:
    for mesh in (EVEN, DOME):
        places = {tuple(np.round(node, 9)) for node in mesh.nodes}
        for x, y in itertools.product((1, -1), repeat=2):
            turned = mesh.nodes * [x, y, 1]
            assert {tuple(np.round(node, 9) + 0.0) for node in turned} == places
