"""From one deformation to every signal: references, mirror images, variations."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recorder.markers import count_markers, find_blobs, marker_centres
from sim.indenters import named, sphere
from sim.markers import Camera, Renderer
from sim.markers import named as pattern_of
from sim.scene import press
from sim.sensors import (
    CameraReadout,
    CameraSignal,
    DeviceVariation,
    SimulatedSensor,
    SurfaceField,
    readout,
    sensor,
)

Array = NDArray[np.float64]


def dent(
    each: SimulatedSensor, at: tuple[float, float] = (0.0, 0.0), depth: float = 0.8e-3
) -> SurfaceField:
    """Return a smooth dent that squeezes the skin outwards."""
    x = np.linspace(-each.body.size_x / 2, each.body.size_x / 2, 61)
    across, along = np.meshgrid(x, x, indexing="ij")
    width = 0.8 * each.body.thickness
    bell = np.exp(-((across - at[0]) ** 2 + (along - at[1]) ** 2) / width**2)
    u = [
        0.4 * depth * (across - at[0]) / width * bell,
        0.4 * depth * (along - at[1]) / width * bell,
        -depth * bell,
    ]
    return SurfaceField(x, x, np.stack(u, axis=-1)[None].astype(np.float32))


def camera_readout(each: SimulatedSensor, **options: object) -> CameraReadout:
    reader = readout(each, **options)  # type: ignore[arg-type]
    assert isinstance(reader, CameraReadout)
    return reader


def plain(name: str) -> SimulatedSensor:
    return replace(sensor(name), variation=DeviceVariation())


@pytest.fixture(scope="module")
def gelsight() -> CameraReadout:
    return camera_readout(plain("gelsight"))


def test_an_undeformed_skin_is_the_renderers_reference(gelsight: CameraReadout) -> None:
    each = plain("gelsight")
    renderer = Renderer(each.body, Camera.of_scale(0.0249))
    expected = renderer.undeformed().masks(renderer.textures([pattern_of("GelSight")]))
    np.testing.assert_array_equal(gelsight.masks(SurfaceField.undeformed(each.body)), expected)


def test_a_dent_pushes_the_markers_apart(gelsight: CameraReadout) -> None:
    each = plain("gelsight")
    still, moved = (
        marker_centres(gelsight.masks(field)[0, 0])
        for field in (SurfaceField.undeformed(each.body), dent(each))
    )
    middle = np.array([319.5, 239.5])
    radius = np.linalg.norm(still - middle, axis=1)
    ring = (radius > 80) & (radius < 110)
    assert ring.any()
    assert (np.linalg.norm(moved - middle, axis=1) > radius)[ring].all()


def test_a_skin_that_has_crept_shifts_image_and_displacement(gelsight: CameraReadout) -> None:
    still = SurfaceField.undeformed(plain("gelsight").body)
    moved = still.crept(np.array([10 * 0.0249e-3, -2 * 0.0249e-3]))
    before, after = (gelsight.masks(field)[0, 0, :, 100:500] for field in (still, moved))
    shifted = np.roll(gelsight.masks(still)[0, 0], (2, 10), axis=(0, 1))[:, 100:500]
    assert (shifted != after)[10:-10].sum() < 0.01 * before.sum()
    field = gelsight.displacement(moved)
    assert field.shape == (1, 57, 73, 2)
    np.testing.assert_allclose(field[0, 28, 36], [10.0, 2.0], atol=2e-2)


def test_without_a_seed_nothing_varies() -> None:
    lively, each = sensor("array-i"), plain("gelsight")
    alike, top = camera_readout(replace(each, signal=lively.signal)), dent(each)
    np.testing.assert_array_equal(camera_readout(lively).masks(top), alike.masks(top))


def test_lives_differ_between_sensors_and_come_back_the_same() -> None:
    first, second = sensor("array-i"), replace(sensor("array-i"), name="other")
    top = dent(first, (1e-3, 0.5e-3))
    masks = camera_readout(first, seed=1).masks(top)
    again = camera_readout(first, seed=1).masks(top)
    other = camera_readout(second, seed=1).masks(top)
    np.testing.assert_array_equal(masks, again)
    assert (masks != other).mean() > 0.01


def test_mounted_sensors_are_pressed_beside_their_middle() -> None:
    each = sensor("array-i")
    mount = each.variation.mount
    assert mount is not None
    placement = mount.drawn(5, each.name)
    scene = each.placed(named("prism"), press([1e-3]), seed=5)
    x, y, _ = scene.motion.tip[-1]
    assert (x, y) == (-placement.shift_x, -placement.shift_y)
    assert scene.indenter.tilt != (0.0, 0.0)
    assert each.scene(named("prism"), press([1e-3])).indenter == named("prism")


def test_tacpalm_shows_127_round_tips_that_fan_out_under_a_dent() -> None:
    each = plain("tacpalm")
    reader = camera_readout(each)
    still, moved = (
        reader.masks(field)[0, 0]
        for field in (SurfaceField.undeformed(each.body), dent(each, depth=3e-3))
    )
    assert count_markers(still) == count_markers(moved) == 127
    areas = np.asarray(find_blobs(still[None]).area)
    assert np.ptp(areas) <= 8
    middle = np.array([319.5, 239.5])
    spread = [np.linalg.norm(marker_centres(mask) - middle, axis=1) for mask in (still, moved)]
    near = np.sort(spread[0])[1:7], np.sort(spread[1])[1:7]
    assert near[1].min() > near[0].max() + 5


def test_a_stiff_film_rounds_the_edges_of_indenters_that_have_some() -> None:
    each = sensor("tacpalm")
    assert each.scene(named("prism"), press([1e-3])).indenter.edge_radius == pytest.approx(1e-3)
    narrow = named("cylinder_sh")
    felt = each.scene(narrow, press([1e-3])).indenter
    assert felt.edge_radius == pytest.approx(narrow.edge_radius_max)
    assert each.scene(sphere(4e-3), press([1e-3])).indenter == sphere(4e-3)


def test_the_gel_shows_its_twelve_patterns_on_one_deformation() -> None:
    each = sensor("gel")
    assert isinstance(each.signal, CameraSignal)
    masks = camera_readout(each).masks(dent(each))
    assert masks.shape == (1, 12, 480, 640)
    assert len({mask.tobytes() for mask in masks[0]}) == 12
