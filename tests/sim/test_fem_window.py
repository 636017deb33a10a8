from itertools import pairwise

import numpy as np
import pytest

from sim import Body, Indenter, Motion, Scene, SceneError, press
from sim.fem import FOR_EDGES, Fem, Grading
from sim.fem.mesh import MARGIN, Window, contact_window, meshes_of
from sim.fem.sizing import covered
from sim.indenters import bar, cone, flat_punch, named, plane, sphere, torus
from tests.support.few import few

RIM = 0.5e-3
AROUND = np.array([-RIM, RIM])
# Sides of both bodies, along x and y.
SIDES = np.array([-10e-3, 10e-3])
FLAT = Body()
DOMED = Body(dome_radius=60e-3)
INDENTERS = [
    sphere(4e-3),
    flat_punch(0.15e-3),
    cone(0.6, 0.5e-3),
    named("line"),
    named("cylinder_sh"),
    named("dots"),
    named("moon"),
]
MOTIONS = {
    "press": press([0.5e-3, 0.9e-3]),
    "shear": press([0.8e-3], shear=2e-3, angle=0.7, steps=2),
    "off-centre": press([0.9e-3], at=(5e-3, -4e-3)),
    "at the edge": press([0.9e-3], at=(-10e-3, 0.0)),
}


def _footprint(scene: Scene, samples: int = 121) -> np.ndarray:
    """Return the box that the indenter covers on the undeformed top, ((low, high), ...) [m].

    Found point by point on the top, also at positions between the waypoints.
    """
    body, tip = scene.body, np.asarray(scene.motion.tip)
    x = np.linspace(-body.size_x / 2, body.size_x / 2, samples)
    y = np.linspace(-body.size_y / 2, body.size_y / 2, samples)
    grid = *np.meshgrid(x, y, indexing="ij"), body.heights(x, y)
    top = np.stack(grid, axis=-1).reshape(-1, 3)
    covered = np.zeros(len(top), bool)
    for start, end in pairwise(tip):
        for fraction in (0.25, 0.5, 0.75, 1.0):
            covered |= scene.indenter.distance(top - (start + fraction * (end - start)))[0] < 0
    found = top[covered, :2]
    return np.stack([found.min(0), found.max(0)], axis=1)


def _holds(window: Window, box: np.ndarray) -> bool:
    outer = np.array(window)
    return bool((outer[:, 0] <= box[:, 0]).all() and (outer[:, 1] >= box[:, 1]).all())


@pytest.mark.parametrize("body", [FLAT, DOMED], ids=["flat", "domed"])
@pytest.mark.parametrize("motion", few(MOTIONS.values(), 2), ids=MOTIONS)
def test_the_window_holds_the_footprint_and_stays_on_the_body(body: Body, motion: Motion) -> None:
    for indenter in INDENTERS:
        scene = Scene(indenter, motion, body)
        window = contact_window(scene, RIM)
        footprint = _footprint(scene)
        assert _holds(window, footprint), indenter.name
        assert (np.array(window) >= SIDES[0]).all(), indenter.name
        assert (np.array(window) <= SIDES[1]).all(), indenter.name
        if body is FLAT:
            loose = np.array(window) - np.clip(footprint + AROUND, *SIDES)
            assert np.abs(loose).max() < 1e-3, indenter.name


@pytest.mark.parametrize("indenter", [plane(), named("line"), named("wave")])
def test_an_indenter_that_hangs_over_the_edge_is_followed_to_the_far_side(
    indenter: Indenter,
) -> None:
    """It is wider than half the body, and pressed in off-centre."""
    body = Body(size_x=10e-3, size_y=10e-3)
    scene = Scene(indenter, press([1e-3], at=(2e-3, 3e-3)), body)
    assert _holds(contact_window(scene, RIM), _footprint(scene))


@pytest.mark.parametrize("indenter", [torus(2e-3, 0.5e-3), sphere(0.5e-3)])
@pytest.mark.parametrize("body", [FLAT, DOMED], ids=["flat", "domed"])
def test_the_widest_of_an_indenter_counts_when_it_goes_in_deeper(
    indenter: Indenter, body: Body
) -> None:
    """At a depth of 1 mm, their section in the plane of the top is only a point or a line."""
    scene = Scene(indenter, press([1e-3], at=(3e-3, 0.0)), body)
    assert _holds(contact_window(scene, 0.2e-3), _footprint(scene))


def test_the_margin_is_kept_when_it_is_finer_than_the_places_looked_at() -> None:
    """The paper's cylinder ends at 3 mm; the body is sampled every 0.2 mm."""
    scene = Scene(named("cylinder"), press([1e-3], at=(0.1e-3, 0.0)), FLAT)
    assert _holds(contact_window(scene, 0.05e-3), _footprint(scene, samples=401))


def test_a_motion_that_never_touches_has_its_window_around_the_tips_way() -> None:
    motion = Motion(((1e-3, 2e-3, 0.5e-3), (3e-3, -1e-3, 0.1e-3)), (0.0, 1.0))
    for indenter in (sphere(3e-3), cone(0.6)):
        window = contact_window(Scene(indenter, motion, FLAT), RIM)
        way = np.array([[1e-3, 3e-3], [-1e-3, 2e-3]])
        assert np.array(window) == pytest.approx(way + AROUND, abs=0.25e-3)


def test_a_mesh_is_fine_where_the_indenter_comes_and_coarse_elsewhere() -> None:
    scene = Scene(sphere(3e-3), press([1e-3], at=(4e-3, -2e-3)), FLAT)
    for spacing in (None, 0.5e-3):
        mesh = meshes_of([scene], Fem(spacing=spacing))[0]
        asked = spacing or FLAT.thickness / 6
        window = contact_window(scene, MARGIN * asked)
        for places, (low, high) in zip((mesh.x, mesh.y), window, strict=True):
            ends = places * FLAT.thickness
            inside = (ends[:-1] >= low) & (ends[1:] <= high)
            assert inside.any()
            assert np.diff(ends)[inside].max() <= asked * (1 + 1e-3)
            assert np.diff(ends).max() > 1.2 * asked
        even = meshes_of([scene], Fem(spacing=asked, grading=Grading(growth=0.0)))[0]
        np.testing.assert_allclose(np.diff(even.x), even.x[1] - even.x[0])
        assert len(mesh.elements) < len(even.elements)


def test_one_topology_gives_meshes_of_a_call_the_counts_of_the_largest_and_coarsens_none() -> None:
    places = ((0.0, 0.0), (-9e-3, 5e-3))
    scenes = [Scene(sphere(1e-3), press([0.2e-3], at=place), FLAT) for place in places]
    scenes.append(Scene(named("cylinder_sh"), press([1e-3]), FLAT))
    alone = [meshes_of([scene], Fem(spacing=0.5e-3))[0] for scene in scenes]
    alike = meshes_of(scenes, Fem(spacing=0.5e-3, one_topology=True))
    assert len({mesh.cells for mesh in alone}) > 1
    most = [max(mesh.cells[axis] for mesh in alone) for axis in range(3)]
    assert {mesh.cells for mesh in alike} == {tuple(most)}
    for one, other in zip(alone, alike, strict=True):
        assert other.finest <= one.finest * (1 + 1e-9)


def test_a_grading_for_edges_is_finer_in_plan_and_as_fine_over_the_depth() -> None:
    scene = Scene(sphere(3e-3), press([1e-3]), FLAT)
    usual = meshes_of([scene], Fem(spacing=0.5e-3))[0]
    edges = meshes_of([scene], Fem(spacing=0.5e-3, grading=FOR_EDGES))[0]
    assert edges.finest <= FOR_EDGES.finer * 0.5e-3 / FLAT.thickness * (1 + 1e-9)
    assert edges.finest < usual.finest
    assert edges.cells[2] == usual.cells[2]
    assert np.diff(edges.x).max() > np.diff(usual.x).max()
    with pytest.raises(SceneError, match=r"grading.finer: 0"):
        Grading(finer=0.0)


def test_a_corner_that_has_just_touched_is_found() -> None:
    """It overlaps some micrometres of a body of 16 mm; found by random scenes (seed 5, 163)."""
    leaning = bar(0.438e-3, 7.72e-3).tilted(-0.473, 0.163)
    deep = -1.55e-6
    found = covered(leaning, Body(16e-3, 16e-3), np.array([0.9e-3, -2.6e-3, deep]))
    assert found is not None
    low, high = found
    assert (high - low < 0.1e-3).all()
    above = np.array([0.9e-3, -2.6e-3, 1e-6])
    assert covered(leaning, Body(16e-3, 16e-3), above) is None
