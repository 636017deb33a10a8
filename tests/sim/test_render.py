"""Rendering: material points at ray intersections, masks at markers, and nothing else."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, label
from support.devices import DEVICES

from benchmarks.accuracy.images import RenderState, dent, fold, iou, mismatch, state_of
from benchmarks.accuracy.raycast import cast_rays, fraction_of, marked, smooth
from recorder.markers import Lattice, count_markers, pack
from sim.errors import SceneError
from sim.fem import Fem
from sim.indenters import sphere
from sim.markers import SIMULATED, Camera, Pattern, Renderer, Textures, named
from sim.markers.top import cubic_taps
from sim.scene import Body, Scene, press
from sim.tiers import simulate

PIXEL = 33.93e-6
NAMES = ("Array1", "Circle1", "Diamond1", "Array4")
PATTERNS = [named(name) for name in NAMES]
ASIDE = dent(at=(2e-3, -1e-3), aside=(0.6e-3, 0.3e-3))
DOME = dent(Body(dome_radius=60e-3), at=(-1e-3, 2e-3))
DENTS = {"flat": ASIDE, "dome": DOME}


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(Body())


@pytest.fixture(scope="module")
def textures(renderer: Renderer) -> Textures:
    return renderer.textures(PATTERNS)


def rays_of(state: RenderState) -> np.ndarray:
    """Return what rays through the pixels of the default camera hit."""
    return cast_rays(state.body, Camera(), state.x, state.y, state.surface)


def masks(renderer: Renderer, textures: Textures, state: RenderState) -> np.ndarray:
    return renderer.see(state.x, state.y, state.surface[None]).masks(textures)[0]


# Interpolation


@pytest.mark.parametrize("axis", [np.linspace(-1, 1, 9), np.array([0.0, 1, 1.5, 4, 4.2, 6])])
def test_parabolas_come_out_exactly_and_weights_sum_to_one(axis: np.ndarray) -> None:
    places = np.linspace(axis[0], axis[-1], 101)
    taps = cubic_taps(axis, places)
    index = taps.first[:, None] + np.arange(4)
    assert taps.weight.sum(axis=1) == pytest.approx(1, abs=1e-6)
    for power in (0, 1, 2):
        found = (axis[index] ** power * taps.weight).sum(axis=1)
        assert found == pytest.approx(places**power, abs=1e-5)


def test_the_curve_and_its_slope_are_continuous_and_go_on_straight() -> None:
    axis = np.array([0.0, 1, 1.5, 4, 4.2, 6])
    values = np.array([0.0, 2, -1, 3, 1, 0])

    def curve(places: np.ndarray) -> np.ndarray:
        taps = cubic_taps(axis, places)
        return (values[taps.first[:, None] + np.arange(4)] * taps.weight).sum(axis=1)

    assert curve(axis) == pytest.approx(values, abs=1e-6)
    step = 1e-3
    before = (curve(axis) - curve(axis - step)) / step
    after = (curve(axis + step) - curve(axis)) / step
    assert after == pytest.approx(before, abs=0.05)
    beyond = np.array([-0.9, -0.5, -0.1, 6.2, 6.6, 7.0])
    assert np.diff(curve(beyond)[:3]) == pytest.approx([0.4 * before[0]] * 2, rel=2e-2)
    assert np.diff(curve(beyond)[3:]) == pytest.approx([0.4 * after[-1]] * 2, rel=2e-2)


# The material map


@pytest.mark.parametrize("body", DENTS)
def test_pixels_see_what_a_ray_through_them_hits_and_masks_are_those_of_formulas(body: str) -> None:
    state = DENTS[body]
    renderer = Renderer(state.body)
    view = renderer.see(state.x, state.y, state.surface[None])
    seen, rays = view.material()[0], rays_of(state)
    assert np.array_equal(np.isnan(seen), np.isnan(rays))
    off = np.linalg.norm(seen - rays, axis=-1) / PIXEL
    assert np.nanmax(off) < 0.03
    assert np.nanmean(off) < 0.002
    drawn = view.masks(renderer.textures(PATTERNS))[0]
    for pattern, mask in zip(PATTERNS, drawn, strict=True):
        truth = marked(pattern, rays, 1)
        assert iou(mask, truth) > 0.996
        assert mismatch(mask, truth) < 3e-4


def test_a_fold_shows_the_part_that_is_nearer_to_the_camera(renderer: Renderer) -> None:
    state = fold()
    seen = renderer.see(state.x, state.y, state.surface[None]).material()[0]
    off = np.linalg.norm(seen - rays_of(state), axis=-1) / PIXEL
    assert np.nanmax(off) < 0.1
    # Along a row the material jumps from one sheet to the other: the part in between is hidden.
    x = seen[240, :, 0]
    assert np.diff(x[np.isfinite(x)]).max() > 1e-3


@pytest.mark.parametrize(
    "mounted", [Camera(), Camera(shift=(9.0, -4.0), rotation=0.15), Camera(tilt=(0.08, -0.05))]
)
def test_beside_the_gel_nothing_is_seen(mounted: Camera) -> None:
    body = Body(size_x=12e-3, size_y=9e-3)
    seen = Renderer(body, mounted).undeformed().material()[0]
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1)
    places = mounted.places(pixels, body)
    beyond = np.abs(places) - (6e-3, 4.5e-3)
    clear = (np.abs(beyond) > 1e-3 * PIXEL).all(axis=-1)
    on_gel = (beyond < 0).all(axis=-1)
    assert np.array_equal(np.isfinite(seen[..., 0])[clear], on_gel[clear])
    np.testing.assert_allclose(seen[on_gel & clear], places[on_gel & clear], atol=2e-3 * PIXEL)


def test_two_frames_at_once_are_the_two_frames(renderer: Renderer) -> None:
    second = dent(at=(2e-3, -1e-3), depth=0.4e-3)
    both = renderer.see(ASIDE.x, ASIDE.y, np.stack([ASIDE.surface, second.surface]))
    alone = renderer.see(ASIDE.x, ASIDE.y, second.surface[None])
    assert len(both) == 2
    assert np.array_equal(both.material()[1], alone.material()[0], equal_nan=True)


# Masks


def test_the_undeformed_gel_is_its_reference_bit_for_bit(
    renderer: Renderer, textures: Textures
) -> None:
    reference = renderer.undeformed()
    for axis in (ASIDE.x, np.linspace(-9.95e-3, 9.95e-3, 40)):
        still = np.zeros((1, len(axis), len(axis), 3), np.float32)
        view = renderer.see(axis, axis, still)
        assert np.array_equal(view.packed(textures), reference.packed(textures))
        assert np.array_equal(view.material(), reference.material(), equal_nan=True)
        assert np.nanmax(np.abs(renderer.displacement(axis, axis, still))) == 0


def test_packed_bits_are_those_of_the_masks(renderer: Renderer, textures: Textures) -> None:
    view = renderer.see(ASIDE.x, ASIDE.y, ASIDE.surface[None])
    assert view.packed(textures).shape == (1, 4, 38400)
    assert np.array_equal(pack(view.masks(textures)), view.packed(textures))
    place = view.material()[0]
    texture = Textures([named("Circle1")], Body())
    (values,) = texture.values.numpy()
    row, column = ((place - texture.corner) / texture.step)[..., ::-1].reshape(-1, 2).T
    seen = np.isfinite(row)
    r, c = row[seen].astype(int), column[seen].astype(int)
    down, right = row[seen] - r, column[seen] - c
    low = values[r, c] * (1 - right) + values[r, c + 1] * right
    high = values[r + 1, c] * (1 - right) + values[r + 1, c + 1] * right
    distance = low * (1 - down) + high * down
    inside = view.masks(textures)[0, 1].ravel()
    assert not inside[~seen].any()
    # float32 and float64 may differ at distances of a nanometre.
    clear = np.abs(distance) > 5e-9
    assert np.array_equal(inside[seen][clear], (distance <= 0)[clear])


@pytest.mark.slow
def test_grey_images_are_the_share_of_each_pixel(renderer: Renderer, textures: Textures) -> None:
    view = renderer.see(ASIDE.x, ASIDE.y, ASIDE.surface[None])
    grey = view.coverage(textures)[0] / 255
    surface = ASIDE.surface.astype(float)
    rays = cast_rays(ASIDE.body, renderer.camera, ASIDE.x, ASIDE.y, surface, samples=3)
    counted = np.stack([fraction_of(pattern, rays, 3) for pattern in PATTERNS])
    assert np.abs(grey - counted).mean() < 0.004
    assert grey.mean(axis=(1, 2)) == pytest.approx(counted.mean(axis=(1, 2)), rel=5e-3)
    assert mismatch(grey >= 0.5, view.masks(textures)[0]) < 2e-4


@pytest.mark.parametrize(("x", "y"), [(3e-3, 0.0), (0.0, 3e-3)])
def test_mirrored_dents_give_mirrored_images_within_a_pixel(
    renderer: Renderer, textures: Textures, x: float, y: float
) -> None:
    here, there = (
        masks(renderer, textures, dent(at=(side * x, side * y), aside=(side * x / 6, side * y / 6)))
        for side in (1, -1)
    )
    # Array1 and Array4 are symmetric about both axes.
    for one, other in zip(here[[0, 3]], there[[0, 3]], strict=True):
        mirrored = one[:, ::-1] if x else one[::-1]
        assert mismatch(mirrored, other) < 1e-3
        assert not (other & ~binary_dilation(mirrored)).any()


@pytest.mark.parametrize("name", ["Array3", "Circle4", "Diamond3"])
def test_no_marker_is_lost_or_made(name: str) -> None:
    renderer = Renderer(Body(), Camera.of_scale(0.05))
    textures = renderer.textures([named(name)])
    states = [ASIDE, dent(depth=1.5e-3), dent(at=(-5e-3, 4e-3), aside=(0.0, -0.8e-3))]
    assert count_markers(renderer.undeformed().masks(textures)[0, 0]) == len(named(name))
    for state in states:
        assert count_markers(masks(renderer, textures, state)[0]) == len(named(name))


def test_markers_at_the_gels_border_are_drawn_up_to_it() -> None:
    body = Body(size_x=12e-3, size_y=9e-3)
    pattern = Pattern("edge", "square", 1e-3, ((5.5e-3, 4.0e-3), (-5.5e-3, -4.0e-3)))
    renderer = Renderer(body)
    mask = renderer.undeformed().masks(renderer.textures([pattern]))[0, 0]
    _, count = label(mask)
    assert count == 2
    assert mask.sum() * PIXEL**2 == pytest.approx(2e-6, rel=0.05)
    # The gel's border moves outwards, with the marker on it.
    x, y = np.linspace(-6e-3, 6e-3, 13), np.linspace(-4.5e-3, 4.5e-3, 13)
    surface = np.zeros((1, 13, 13, 3), np.float32)
    surface[..., 0] = 0.05 * x[:, None]
    wider = renderer.see(x, y, surface).masks(renderer.textures([pattern]))[0, 0]
    edges = [np.nonzero(each.any(axis=0))[0].max() for each in (mask, wider)]
    assert edges[1] - edges[0] == pytest.approx(0.05 * 6e-3 / PIXEL, abs=1)
    assert wider.sum() > mask.sum()


# Displacement of the image


def test_the_lattice_tells_where_material_went(renderer: Renderer) -> None:
    lattice = Lattice()
    field = renderer.displacement(ASIDE.x, ASIDE.y, ASIDE.surface[None])
    assert field.shape == (1, 57, 73, 2)
    assert field.dtype == np.float16
    for row, column in ((28, 36), (20, 45), (33, 30), (8, 20)):
        pixel = np.array([lattice.columns[column], lattice.rows[row]])
        place = renderer.camera.places(pixel, renderer.body)
        moved = smooth(ASIDE.x, ASIDE.y, ASIDE.surface.astype(float), place[:1], place[1:])[0, 0]
        after = renderer.camera.project(np.append(place, 0) + moved)
        assert field[0, row, column] == pytest.approx(after - pixel, abs=0.02)
    # The gel ends at 24.8 and 614.2 px.
    assert np.isnan(field[0, 28, lattice.columns < 24]).all()
    assert np.isnan(field[0, 28, lattice.columns > 615]).all()
    assert np.isfinite(field[0, 28, (lattice.columns > 25) & (lattice.columns < 614)]).all()


# Invalid values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: replace(s, surface=s.surface * np.nan), "surface: not finite"),
        (lambda s: replace(s, surface=s.surface[:-1]), r"shape \(1, 60, 61, 3\); allowed"),
        (lambda s: replace(s, surface=s.surface * 1e3), "is it in metres"),
        (lambda s: replace(s, surface=s.surface * 8), "down; allowed: up to the gel's thickness"),
        (lambda s: replace(s, x=s.x * 0.8), "surface_x: -0.008 to 0.008"),
        (lambda s: replace(s, y=s.y[::-1]), "surface_y: does not rise"),
    ],
)
def test_what_is_no_surface_is_refused(
    renderer: Renderer, change: Callable[[RenderState], RenderState], message: str
) -> None:
    state = change(ASIDE)
    with pytest.raises(SceneError, match=message):
        renderer.see(state.x, state.y, state.surface[None])


# Solved presses, other devices, measurements


@pytest.mark.slow
def test_a_solved_press_renders_as_rays_see_it_and_symmetrically(
    renderer: Renderer, textures: Textures
) -> None:
    result = simulate(Scene(sphere(4e-3), press([1.2e-3])), Fem(spacing=1e-3))
    state = state_of("pressed", result, -1)
    drawn = masks(renderer, textures, state)
    rays = rays_of(state)
    for pattern, mask in zip(PATTERNS, drawn, strict=True):
        assert iou(mask, marked(pattern, rays, 1)) > 0.995
    for mask in drawn[[0, 3]]:
        assert not (mask & ~binary_dilation(mask[:, ::-1])).any()
        assert not (mask & ~binary_dilation(mask[::-1])).any()


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_devices_agree_and_repeat_themselves_bit_for_bit(device: str) -> None:
    patterns = [named(name) for name in SIMULATED]
    found = []
    for where in (device, device) if device == "cpu" else ("cpu", device, device):
        renderer = Renderer(Body(), device=where)
        packed = [
            renderer.see(state.x, state.y, state.surface[None]).packed(renderer.textures(patterns))
            for state in (ASIDE, fold())
        ]
        found.append(np.concatenate(packed))
    host, first = (np.unpackbits(each, axis=-1).astype(bool) for each in (found[0], found[-2]))
    assert np.array_equal(found[-2], found[-1])
    assert mismatch(host, first) < 2e-5
