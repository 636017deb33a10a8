from __future__ import annotations

import itertools

import numpy as np
import pytest

from sim import Body, SceneError
from sim.fem.mesh import CELLS_MAX, Mesh, build_mesh

FLAT = Body(size_x=6e-3, size_y=5e-3, thickness=3e-3)
DOMED = Body(size_x=6e-3, size_y=6e-3, thickness=3e-3, dome_radius=9e-3)


def _flat() -> Mesh:
    return build_mesh(FLAT, 1e-3)


def test_volumes_and_areas_are_the_bodys() -> None:
    mesh = _flat()
    unit = FLAT.thickness
    volume = FLAT.size_x * FLAT.size_y * FLAT.thickness / unit**3
    assert mesh.cells == (6, 5, 3)
    assert mesh.weight.sum() == pytest.approx(volume)
    assert mesh.node_volume.sum() == pytest.approx(volume)
    sides = 2 * (FLAT.size_x + FLAT.size_y) * FLAT.thickness + FLAT.size_x * FLAT.size_y
    assert 4 * mesh.face_area.sum() == pytest.approx(sides / unit**2)
    assert (mesh.weight > 0).all()


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
    apex = build_mesh(DOMED, 1e-3)
    assert apex.nodes[apex.top[3, 3]] == pytest.approx([0, 0, 0], abs=1e-12)


def test_nodes_know_the_elements_and_faces_around_them() -> None:
    mesh = _flat()
    for around, cells in ((mesh.node_elements, mesh.elements), (mesh.node_faces, mesh.faces)):
        corners = cells.shape[1]
        listed = around[around >= 0]
        assert sorted(listed) == list(range(cells.size)), "every corner of every cell once"
        for node, row in enumerate(around):
            for place in row[row >= 0]:
                assert cells[place // corners, place % corners] == node


def test_only_the_base_is_held_and_only_it_is_not_a_face() -> None:
    mesh = _flat()
    np.testing.assert_array_equal(~mesh.free, mesh.nodes[:, 2] == -1)
    on_base = (mesh.nodes[mesh.faces][:, :, 2] == -1).all(axis=1)
    assert not on_base.any()
    boundary = np.bincount(mesh.faces.ravel(), minlength=len(mesh.nodes)) > 0
    inside = (
        (np.abs(mesh.nodes[:, 0]) < 0.999)
        & (np.abs(mesh.nodes[:, 1]) < 0.83)
        & (mesh.nodes[:, 2] < -1e-9)
        & mesh.free
    )
    assert not (boundary & inside).any()


def test_the_mesh_is_a_mirror_image_of_itself() -> None:
    for mesh in (_flat(), build_mesh(DOMED, 1e-3)):
        places = {tuple(np.round(node, 9)) for node in mesh.nodes}
        for x, y in itertools.product((1, -1), repeat=2):
            turned = mesh.nodes * [x, y, 1]
            assert {tuple(np.round(node, 9) + 0.0) for node in turned} == places


@pytest.mark.parametrize(
    ("spacing", "said"),
    [
        (0.0, "above 0"),
        (float("nan"), "above 0"),
        (-1e-3, "above 0"),
        (1.5e-3, "up to 1 mm"),
        (5e-6, f"up to {CELLS_MAX}"),
    ],
)
def test_spacings_that_make_no_mesh_are_refused_with_what_is_allowed(
    spacing: float, said: str
) -> None:
    with pytest.raises(SceneError, match="mesh") as refused:
        build_mesh(FLAT, spacing)
    assert said in str(refused.value)
