import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from sim.fem import Fem, solver
from sim.fem.sizing import (
    FLATTER,
    NOTHING,
    Span,
    coarser_than_required,
    resolved,
    sizes_of,
    stages_of,
)
from sim.fem.solver import refines, simulate_fem
from sim.indenters import sphere
from sim.indenters.shapes import bar
from sim.result import Result, half_widths
from sim.scene import Body, Motion, Scene, press


def test_a_piece_asks_for_the_same_sizes_alone_and_beside_others() -> None:
    random = np.random.default_rng(3)
    for _draw in range(20):
        x, y = (np.cumsum(random.uniform(0.2, 1.0, 50)) for _axis in range(2))
        soft = ndimage.gaussian_filter(random.normal(size=(50, 50)), 3.0)
        touched = soft > np.quantile(soft, 0.8)
        pieces, count = ndimage.label(touched, structure=np.ones((3, 3)))
        assert count > 1
        whole = sizes_of(touched, x, y, 4.0, 0.5)
        alone = [sizes_of(pieces == piece, x, y, 4.0, 0.5) for piece in range(1, count + 1)]
        assert whole.top == min(one.top for one in alone)
        assert whole.width == max(one.width for one in alone)
        spans = {span for one in alone for span in one.x}
        assert set(whole.x) <= spans
        assert min(span.size for span in whole.x) == min(span.size for span in spans)


def test_contacts_of_many_frames_are_measured_as_each_alone() -> None:
    random = np.random.default_rng(4)
    soft = ndimage.gaussian_filter(random.normal(size=(12, 40, 30)), (0.0, 3.0, 3.0))
    touched = soft > 0.08
    touched[3], touched[7] = False, touched[6]
    x, y = (np.cumsum(random.uniform(0.2e-3, 1e-3, count)) for count in touched.shape[1:])
    body = Body(thickness=4e-3)
    found = resolved(touched, x, y, body=body, top=2e-4)
    alone = [resolved(one[None], x, y, body=body, top=2e-4)[0] for one in touched]
    np.testing.assert_array_equal(found, alone)
    sizes = [sizes_of(one, x, y, 4e-3) for one in touched]
    worst = [coarser_than_required(one, x, y) for one in sizes]
    worst = [max(one, 2e-4 / (FLATTER * of.top)) for one, of in zip(worst, sizes, strict=True)]
    np.testing.assert_array_equal(np.isinf(found), ~touched.any(axis=(1, 2)))
    np.testing.assert_allclose(1 / found, worst, rtol=1e-15)


def test_the_largest_disc_is_that_of_a_distance_transform() -> None:
    """Of pieces of any shape, among them one along a diagonal, on pixels of different sizes."""
    random = np.random.default_rng(5)
    soft = ndimage.gaussian_filter(random.normal(size=(20, 40, 60)), (0.0, 2.0, 2.0))
    masks = soft > random.uniform(-0.1, 0.1, (20, 1, 1))
    across = np.arange(40)[:, None] - np.arange(60)
    masks[0], masks[1], masks[2] = np.abs(across) < 3, across == 0, True
    edges = [np.cumsum(random.uniform(0.2, 1.0, count)) for count in (41, 61)]
    for mask, found in zip(masks, half_widths(masks, *edges), strict=True):
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        even, steps = [], []
        for of, on in zip(edges, (rows, columns), strict=True):
            ends = of[on[0] : on[-1] + 2]
            count = int(min(max(np.ceil(2 * (ends[-1] - ends[0]) / np.diff(ends).min()), 8), 192))
            steps.append((ends[-1] - ends[0]) / count)
            places = ends[0] + steps[-1] * (np.arange(count) + 0.5)
            even.append(np.searchsorted(of, places) - 1)
        inside = np.pad(mask[np.ix_(*even)], 1)
        reach = ndimage.distance_transform_edt(inside, sampling=steps).max()
        assert found == pytest.approx(max(reach - min(steps) / 2, min(steps) / 2), rel=1e-14)


def test_a_mesh_is_rebuilt_only_if_the_limit_on_elements_leaves_it_finer() -> None:
    scene, limited = Scene(sphere(4e-3), press([0.5e-3])), Fem(elements_max=1000)
    (found,) = simulate_fem([scene], limited)
    assert isinstance(found, Result)
    assert found.record["mesh"]["fineness"] < limited.fineness
    asked = stages_of(scene)[0].sizes
    x, y = (tuple(one._replace(size=one.size / 2) for one in spans) for spans in (asked.x, asked.y))
    everywhere = replace(asked, x=x, y=y, top=asked.top / 2)
    assert not refines(scene, limited, asked, everywhere, found)
    assert refines(scene, replace(limited, elements_max=40_000), asked, everywhere, found)
    size = min(span.size for span in asked.x) / 4
    at_edge = replace(everywhere, x=(Span(1e-3, 1e-3 + size, size),), y=())
    assert refines(scene, limited, asked, at_edge, found)


@pytest.mark.parametrize(("lacking", "meshes"), [([4.0, 4.0], 1), ([4.0, 2.0], 2)])
def test_a_mesh_is_rebuilt_again_only_if_the_last_time_was_of_use(
    monkeypatch: pytest.MonkeyPatch, lacking: list[float], meshes: int
) -> None:
    left = iter(lacking)
    monkeypatch.setattr(solver, "more_wanted", lambda _result: NOTHING)
    monkeypatch.setattr(solver, "refines", lambda *_given: True)
    monkeypatch.setattr(solver, "coarseness", lambda _result: next(left))
    (found,) = simulate_fem([Scene(sphere(4e-3), press([0.5e-3]))], Fem(elements_max=1000))
    assert isinstance(found, Result)
    assert found.record["mesh"]["made_anew"] == meshes


def test_a_needle_hundreds_of_times_as_long_as_its_contact_is_wide_has_sizes() -> None:
    needle = bar(0.481e-3, 10e-3)
    (stage,) = stages_of(Scene(needle, press([1.8e-6]), Body(size_x=16e-3, size_y=16e-3)))
    half_width = math.sqrt(2 * 0.481e-3 * 1.8e-6)
    assert 0.3 * half_width < stage.sizes.width < 3 * half_width


def test_a_way_that_presses_between_waypoints_that_do_not_has_a_mesh() -> None:
    tips = (-6e-3, 0.0, -1e-4), (6e-3, 0.0, -1e-4)
    over_dome = Scene(
        sphere(1e-3), Motion(tips, (0.0, 1.0)), Body(20e-3, 20e-3, 4e-3, dome_radius=60e-3)
    )
    (stage,) = stages_of(over_dome)
    assert stage.waypoints == 2
    assert 0.0 < stage.sizes.top < 1e-3
