from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.direct_translators import PLAIN, TINY, coarse, encoder, finished_run, tiny_network
from support.made_up_archives import made_up_archive

from learning.data.images import shrink
from learning.data.splits import Split, make_split
from learning.errors import LearningError
from learning.training.checkpoint import read_model_folder
from learning.translation import load_translator
from learning.translation.direct.data import (
    AlignedImages,
    align,
    all_pairs,
    blot,
    disturb_source,
    draw_examples,
    examples_at,
    move_edges,
)
from learning.translation.direct.network import DirectNetwork, fetched
from learning.translation.direct.train import Augmentation
from recorder import MarkerArchive
from recorder.archive import location_pairs


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    path = tmp_path_factory.mktemp("archive") / "made-up.markers.zarr"
    return made_up_archive(path, indenters=("sphere",), unseen=(), frames_per_phase=1)


@pytest.fixture(scope="module")
def split(archive: MarkerArchive) -> Split:
    return make_split(archive, validation=0.3, new_press=0)


@pytest.fixture(scope="module")
def aligned(archive: MarkerArchive, split: Split) -> AlignedImages:
    return align(archive, split, "train")


def test_moments_are_the_location_pairs_of_presses_to_train_on(
    archive: MarkerArchive, split: Split, aligned: AlignedImages
) -> None:
    dots, grid = archive["dots"], archive["grid"]
    pairs = location_pairs(dots.table, grid.table)
    kept = np.isin(dots.table["location"][pairs.source], split.locations("train"))
    assert aligned.sensors == ("dots", "grid")
    assert len(aligned) == kept.sum() == 4
    for row, sensor, rows in ((0, dots, pairs.source), (1, grid, pairs.target)):
        expected = torch.from_numpy(shrink(sensor.packed(rows[kept])))
        assert torch.equal(aligned.images[row], expected)
        reference = torch.from_numpy(shrink(sensor.references))[0]
        assert torch.equal(aligned.references[aligned.reference[row, 0]], reference)


def test_sensors_of_one_surface_share_its_fields(aligned: AlignedImages) -> None:
    assert aligned.fields is not None
    assert aligned.fields.shape[:3] == (1, 4, 2)
    assert aligned.field_of == (0, 0)
    assert float(aligned.fields.abs().amax()) > 5


def test_an_archive_without_fields_is_aligned_all_the_same(tmp_path: Path) -> None:
    bare = made_up_archive(
        tmp_path / "bare.markers.zarr",
        indenters=("sphere",),
        unseen=(),
        targets=1,
        frames_per_phase=1,
        displacement=False,
    )
    aligned = align(bare, make_split(bare, validation=0, new_press=0), "train")
    assert aligned.fields is None
    assert aligned.field_of == (-1, -1)
    drawn = draw_examples(
        aligned,
        all_pairs(2),
        4,
        replace(PLAIN, procedural_source=1.0),
        np.random.default_rng(0),
    )
    assert drawn.source.shape == (4, 1, 256, 256)


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        (("dots",), "two or more different"),
        (("dots", "dots"), "two or more different"),
        (("dots", "none"), "found 'none'"),
    ],
)
def test_sensors_that_make_no_pairs_are_refused(
    archive: MarkerArchive, split: Split, sensors: tuple[str, ...], message: str
) -> None:
    with pytest.raises(LearningError, match=message):
        align(archive, split, "train", sensors=sensors)


def test_a_sensor_that_is_held_out_is_not_trained_on(archive: MarkerArchive) -> None:
    without = make_split(archive, validation=0.3, new_press=0, held_out_sensors=("grid",))
    with pytest.raises(LearningError, match="found 'grid'; allowed: dots"):
        align(archive, without, "train", sensors=("dots", "grid"))


def test_plain_examples_are_what_the_archive_holds(aligned: AlignedImages) -> None:
    drawn = draw_examples(aligned, ((0, 1),), 5, PLAIN, np.random.default_rng(1))
    moments = np.random.default_rng(1).integers(len(aligned), size=5)
    expected = aligned.images[1][torch.from_numpy(moments)].float() / 255
    assert torch.equal(drawn.target[:, 0], expected)
    assert torch.equal(drawn.reference[0, 0], aligned.references[1].float() / 255)
    assert bool(drawn.given.all())


def test_the_same_chance_draws_the_same_examples(aligned: AlignedImages) -> None:
    small = coarse(aligned)
    one, same, other = (
        draw_examples(small, all_pairs(2), 6, Augmentation(), np.random.default_rng(seed))
        for seed in (0, 0, 1)
    )
    for name in ("source", "source_reference", "given", "reference", "target"):
        assert torch.equal(getattr(one, name), getattr(same, name))
    assert not torch.equal(one.source, other.source)


def test_random_patterns_take_the_place_of_what_they_are_asked_to(
    aligned: AlignedImages,
) -> None:
    plain = draw_examples(aligned, ((0, 1),), 3, PLAIN, np.random.default_rng(2))
    options = replace(PLAIN, procedural_source=1.0)
    drawn = draw_examples(aligned, ((0, 1),), 3, options, np.random.default_rng(2))
    assert torch.equal(drawn.target, plain.target)
    assert torch.equal(drawn.reference, plain.reference)
    for name in ("source", "source_reference"):
        assert not torch.equal(getattr(drawn, name), getattr(plain, name))


def test_a_random_target_moves_as_the_source_does(aligned: AlignedImages) -> None:
    # With a uniform field the reference's pattern is the target's, shifted.
    assert aligned.fields is not None
    even = torch.zeros_like(aligned.fields)
    even[:, :, 0] = 20.0
    shifted = replace(aligned, fields=even)
    options = replace(PLAIN, procedural_target=1.0)
    drawn = draw_examples(shifted, ((0, 1),), 2, options, np.random.default_rng(3))
    assert torch.allclose(drawn.target[..., 8:], drawn.reference[..., :-8], atol=1e-3)


def test_edges_move_by_what_they_are_told() -> None:
    image = torch.zeros(2, 1, 32, 32)
    image[..., :16] = 1
    moved = move_edges(image, torch.tensor([0.7, -0.7]))
    assert moved[:, 0, 16].sum(dim=1).tolist() == pytest.approx([16.7, 15.3], abs=0.1)
    straight = move_edges(image, torch.zeros(2))
    assert float(straight[0, 0, 16].sum()) == pytest.approx(16, abs=1e-3)


def test_blots_hide_as_much_as_they_may() -> None:
    image = torch.ones(64, 1, 128, 128)
    hidden = 1 - blot(image, 0.1, np.random.default_rng(0)).mean(dim=(1, 2, 3))
    assert 0.03 < float(hidden.mean()) < 0.06
    assert torch.equal(blot(image, 0.0, np.random.default_rng(0)), image)


def test_a_mounting_shows_in_frame_and_reference_alike() -> None:
    image = torch.zeros(8, 1, 64, 64)
    image[:, :, 24:40, 24:40] = 1
    options = replace(PLAIN, mount_shift=6.0)
    frame, reference = disturb_source(image, image, options, np.random.default_rng(0))
    assert torch.equal(frame, reference)
    assert not torch.equal(frame, image)


def test_the_source_encoder_begins_as_the_reference_encoder() -> None:
    network = tiny_network()
    image = torch.rand(2, 1, 32, 32)
    anything = torch.rand(2, 1, 32, 32)
    seen = network.source_encoder(torch.cat([image, anything], dim=1))
    for one, other in zip(seen, network.reference_encoder(image), strict=True):
        assert torch.allclose(one, other, atol=1e-5)


def test_features_come_from_where_the_way_leads() -> None:
    image = torch.rand(1, 1, 16, 16)
    way = torch.zeros(3, 2, 4, 4)
    way[1, 0], way[2, 1] = 2 / 16, 3 / 16
    still, left, up = fetched(image, way)
    assert torch.allclose(still, image[0], atol=1e-6)
    assert torch.allclose(left[:, :, :14], image[0, :, :, 2:], atol=1e-5)
    assert torch.allclose(up[:, :13], image[0, :, 3:], atol=1e-5)
    assert float(left[:, :, 14:].abs().max()) == pytest.approx(0, abs=1e-5)


def test_an_encoder_of_other_widths_is_refused() -> None:
    network = DirectNetwork((8, 8, 16), 1, 2)
    with pytest.raises(LearningError, match=r"widths: found \(8, 16, 16\)"):
        network.start_from(encoder((8, 16, 16)))


def test_without_its_reference_a_source_is_translated_as_if_it_were_any(
    aligned: AlignedImages,
) -> None:
    network = tiny_network()
    with torch.no_grad():  # initially it ignores the source's reference
        first = network.source_encoder.halvings[0].weight
        first[:, 1] = torch.randn_like(first[:, 1])
    batch = examples_at(coarse(aligned), np.array([0, 1]), np.array([[0, 1], [0, 1]]))
    absent = torch.zeros(2, dtype=torch.bool)
    with torch.no_grad():
        one, other = (
            network(batch.source, batch.reference, beside, absent)
            for beside in (batch.source_reference, torch.rand_like(batch.source_reference))
        )
        looked = network(batch.source, batch.reference, batch.source_reference, ~absent)
    assert torch.equal(one, other)
    assert not torch.equal(one, looked)


def test_a_finished_run_is_a_translator(archive: MarkerArchive, tmp_path: Path) -> None:
    finished_run(tmp_path / "run")
    translator = load_translator(tmp_path / "run")
    mark = read_model_folder(tmp_path / "run").hash()[:8]
    assert translator.name == f"direct[{mark}]"
    frames = torch.from_numpy(archive["dots"].masks(slice(0, 3)))
    target = torch.from_numpy(archive["grid"].reference(0))
    rest = frames[0]
    made = translator.translate(frames, target, rest)
    assert made.dtype == torch.bool
    assert made.shape == frames.shape
    alone = translator.translate(frames[1:2], target, rest)
    assert float((alone[0] != made[1]).float().mean()) < 1e-3
    # Without a reference, the first frame of a press is used.
    assert torch.equal(translator.translate(frames, target, ordered=True), made)
    assert translator.translate(frames[:0], target).shape == (0, 480, 640)


def test_masks_of_another_shape_are_refused(tmp_path: Path) -> None:
    finished_run(tmp_path / "run")
    translator = load_translator(tmp_path / "run")
    with pytest.raises(LearningError, match="source: found uint8"):
        translator.translate(
            torch.zeros(1, 480, 640, dtype=torch.uint8), torch.zeros(480, 640, dtype=torch.bool)
        )


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    finished_run(tmp_path / "run", replace(TINY, blocks=2))
    config = tmp_path / "run/config.yaml"
    config.write_text(config.read_text().replace("blocks: 2", "blocks: 1"))
    with pytest.raises(LearningError, match="not the weights of this network"):
        load_translator(tmp_path / "run")
