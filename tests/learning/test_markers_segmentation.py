"""Presets, masks and centres: measured on pictures with known markers."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support import marker_truth

from learning.errors import LearningError
from learning.markers import (
    CameraPreset,
    Segmenter,
    TaxelPreset,
    grey,
    names,
    preset,
    preset_of_sensor,
    read_preset,
)
from learning.markers.frames import taxel_masks
from learning.markers.segment import (
    BlurDifference,
    ColourBelow,
    Contrast,
    Dark,
    Morphology,
    Region,
    built_preset,
)
from recorder.markers import draw_discs, find_blobs, marker_centres, place_discs

OWN = "kind: camera\ndescription: a\ndetectors: "


def camera_preset(name: str) -> CameraPreset:
    found = preset(name)
    assert isinstance(found, CameraPreset)
    return found


@pytest.mark.parametrize("name", names())
def test_every_preset_that_is_shipped_can_be_read(name: str) -> None:
    found = preset(name)
    assert found.description
    for sensor in found.sensors:
        assert preset_of_sensor(sensor) == name


def test_the_authors_numbers_are_theirs() -> None:
    lit, white, tip = (camera_preset(name) for name in ("gelsight", "gelsight-white", "tacpalm"))
    assert lit.detectors == (BlurDifference(15, 5.0, 150 - 128), Dark(70))
    assert white.detectors == (BlurDifference(15, 5.0, 160 - 128), Dark(70))
    assert [step.size_px for step in (*lit.morphology, *white.morphology)] == [5] * 3 + [3] * 3
    assert tip.detectors == (ColourBelow(100, 100, 30),)
    assert (tip.region.rows, tip.region.columns) == ((50, 380), (180, 510))
    assert len(tip.region.polygon) == 6
    assert tip.equalise
    assert tip.invert
    assert (lit.box_px, tip.box_px) == (15, 12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kind: lidar\n", r"x\.yaml\.kind: found 'lidar'; allowed: camera, taxels"),
        ("kind: camera\ndescription: a\n", "missing detectors"),
        (
            f"{OWN}[{{kind: blur_difference, kernel_px: 4, sigma_px: 1, least: 3}}]",
            r"kernel_px: found 4; allowed: odd",
        ),
    ],
)
def test_a_preset_that_is_wrong_is_refused_with_file_and_key(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(LearningError, match=message) as error:
        read_preset(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("name", list(marker_truth.VIEWS))
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_markers_of_the_mock_benches_are_found_where_they_are(name: str, noise: float) -> None:
    known = list(marker_truth.mock_pictures(marker_truth.VIEWS[name], grey_noise=noise, frames=4))
    found = marker_truth.measure(known, name)
    assert found.missed == 0
    assert found.iou > 0.95
    assert found.rms_px < 0.15
    assert found.worst_px < 0.2


@pytest.mark.slow
def test_markers_of_the_simulated_gelsight_are_found_under_coloured_lamps() -> None:
    known = list(marker_truth.simulated_pictures())
    ours = marker_truth.measure(known, "bench-gelsight")
    assert ours.missed == 0
    assert ours.iou > 0.97
    assert ours.rms_px < 0.1
    for name in ("gelsight", "gelsight-white"):
        theirs = marker_truth.measure(known, name)
        assert theirs.missed == 0
        assert 0.6 < theirs.iou < ours.iou


def test_the_authors_tactip_pipeline_finds_white_pins_in_its_hexagon() -> None:
    picture = np.full((480, 640, 3), 70, np.uint8)
    inside = [(345 + 40 * i, 215 + 45 * j) for i in (-2, -1, 0, 1, 2) for j in (-1, 0, 1)]
    for column, row in [*inside, (60, 60), (600, 400)]:
        cv2.circle(picture, (column, row), 7, (255, 255, 255), -1)
    centres = marker_centres(Segmenter(camera_preset("tacpalm")).mask(picture))
    expected = [
        (80 + (c - 180 + 0.5) * 480 / 330 - 0.5, (r - 50 + 0.5) * 480 / 330 - 0.5)
        for c, r in inside
    ]
    assert len(centres) == len(inside)
    apart = np.linalg.norm(np.array(expected)[:, None] - centres[None], axis=-1)
    assert apart.min(axis=1).max() < 2.0


def test_nothing_is_found_where_there_is_nothing() -> None:
    noise = np.random.default_rng(1).normal(120, 3, (480, 640, 3))
    picture = np.clip(noise, 0, 255).astype(np.uint8)
    for name in ("bench-gelsight", "bench-tacpalm"):
        assert not Segmenter(camera_preset(name)).mask(picture).any()


def test_patches_of_the_wrong_size_are_dropped_and_others_kept() -> None:
    picture = np.full((480, 640, 3), 200, np.uint8)
    for column, radius in ((100, 3), (300, 10), (500, 40)):
        cv2.circle(picture, (column, 240), radius, (0, 0, 0), -1)
    own = CameraPreset("", (Dark(100),), area_px=(100, 1000))
    assert marker_centres(Segmenter(own).mask(picture)).tolist() == [[300.0, 240.0]]


def test_detectors_are_put_together_and_morphology_goes_in_order() -> None:
    picture = np.full((480, 640, 3), 200, np.uint8)
    picture[100:120, 100:120] = 0
    picture[300:320, 300:320] = (90, 90, 20)
    own = CameraPreset("", (Dark(50),))
    both = replace(own, detectors=(Dark(50), ColourBelow(100, 100, 30)))
    grown = replace(own, morphology=(Morphology("dilate", 3, shape="square"),))
    steps = (Morphology("open", 31, shape="square"), Morphology("dilate", 3))
    opened = replace(own, morphology=steps)
    areas = [Segmenter(one).mask(picture).sum() for one in (own, both, grown, opened)]
    assert areas == [400, 800, 22 * 22, 0]


def test_a_region_is_cut_and_resized_and_a_picture_that_lacks_it_refused() -> None:
    picture = np.full((240, 320, 3), 200, np.uint8)
    cv2.circle(picture, (160, 120), 10, (0, 0, 0), -1)
    own = CameraPreset("", (Dark(100),), region=Region(rows=(60, 180), columns=(80, 240)))
    (place,) = marker_centres(Segmenter(own).mask(picture))
    # Column 160 of the picture is 80.5 from the left of the region, which is 160 wide.
    np.testing.assert_allclose(place, [80.5 * 4 - 0.5, 60.5 * 4 - 0.5], atol=0.3)
    with pytest.raises(LearningError, match=r"region\.rows: found 60 to 180; the picture has 100"):
        Segmenter(own).mask(picture[:100])


def test_centres_say_which_markers_the_border_cuts() -> None:
    mask = np.zeros((480, 640), np.bool_)
    mask[0:10, 100:120] = mask[200:210, 300:320] = mask[460:480, 620:640] = True
    centres = find_blobs(mask[None])
    assert centres.whole.tolist() == [False, True, False]
    assert centres.area.tolist() == [200, 200, 400]


def test_luma_weighs_colours_as_the_standard_does() -> None:
    picture = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], np.uint8)
    assert grey(picture).tolist() == [[76, 150, 29]]


def test_contrast_follows_uneven_light() -> None:
    light = (60 + np.mgrid[:480, :640][1] / 4).astype(np.uint8)
    picture = np.repeat(light[..., None], 3, axis=2)
    places = [(60 + 80 * k, 240) for k in range(8)]
    for place in places:
        dark = tuple(int(v) // 4 for v in picture[place[1], place[0]])
        cv2.circle(picture, place, 10, dark, -1)
    own = CameraPreset("", (Contrast(49, 30),), area_px=(100, 900))
    centres = marker_centres(Segmenter(own).mask(picture))
    assert sorted(centres[:, 0].round().tolist()) == [place[0] for place in places]


def test_taxels_are_drawn_less_those_without_contact() -> None:
    counts = np.zeros((2, 16, 3))
    counts[1, 5] = (1500, -1000, 4000)
    no_contact = np.random.default_rng(0).integers(20_000, 40_000, (16, 3))
    plain, turned = TaxelPreset(""), TaxelPreset("", rows_from_top=True)
    masks = taxel_masks(counts + no_contact, no_contact, plain)
    np.testing.assert_array_equal(masks, draw_discs(counts))
    # Taxel 5 is in the second row from the top, where taxel 9 is if y is flipped.
    mirrored = np.zeros((16, 3))
    mirrored[9] = (1500, 1000, 4000)
    np.testing.assert_array_equal(
        taxel_masks(counts + no_contact, no_contact, turned)[1], draw_discs(mirrored)
    )
    centre, _ = place_discs(mirrored)
    assert centre[9, 1] < 288 - 10
    content = {"kind": "taxels", "description": "", "discs": {"shear_per_count": 1e-4}}
    halved = taxel_masks(counts + no_contact, no_contact, built_preset(content, "own"))
    np.testing.assert_array_equal(halved, draw_discs(counts * (0.5, 0.5, 1.0)))


@pytest.mark.parametrize("shape", [(320, 240), (240, 320), (240, 426)])
def test_pictures_keep_their_aspect_and_their_filled_edge_has_no_markers(
    shape: tuple[int, int],
) -> None:
    """A marker at the edge of the picture does not go on into what fills the 640 x 480."""
    picture = np.full((*shape, 3), 180, np.uint8)
    places = [(c, r) for c in range(0, shape[1], 40) for r in range(0, shape[0], 40)]
    for place in places:
        cv2.circle(picture, place, 8, (20, 20, 20), -1)
    segmenter = Segmenter(CameraPreset("", (Dark(100),)))
    centres = marker_centres(segmenter.mask(picture))
    scale = min(480 / shape[0], 640 / shape[1])
    first = (640 - round(scale * shape[1])) // 2, (480 - round(scale * shape[0])) // 2
    inner = [(c, r) for c, r in places if 8 < c < shape[1] - 8 and 8 < r < shape[0] - 8]
    expected = np.array(first) + (np.array(inner) + 0.5) * scale - 0.5
    apart = np.linalg.norm(expected[:, None] - centres[None], axis=-1)
    assert apart.min(axis=1).max() < 1
    assert len(centres) == len(places)
