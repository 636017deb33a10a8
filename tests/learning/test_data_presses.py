"""Presses in memory: the right frames in the right order, from every kind of source."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.made_up_archives import archive_of, made_up_archive

from learning.data.images import read_fields, sampled, shrink
from learning.data.presses import ForceRange, load_presses, press_table, read_frames_of
from learning.errors import LearningError
from recorder import MarkerArchive, SessionError
from recorder.archive import archive_fingerprint

archive = archive_of(frames_per_phase=1, force_depth=2, unlabelled=("grid",), invalid=(7,))


def _rows(archive: MarkerArchive, sensor: str = "dots") -> np.ndarray:
    return np.flatnonzero(archive[sensor].table["valid"])


def test_frames_lie_press_after_press_in_order_of_time(archive: MarkerArchive) -> None:
    rows = np.random.default_rng(0).permutation(_rows(archive))
    reported: list[tuple[int, int]] = []
    presses = load_presses(archive["dots"], rows, progress=lambda *now: reported.append(now))
    assert (reported[0], reported[-1]) == ((0, len(rows)), (len(rows), len(rows)))
    assert len(presses) == 3 * 2 + 2
    assert presses.frames == len(rows)
    table = archive["dots"].table
    for press in range(len(presses)):
        mine = presses.rows[presses.starts[press] : presses.starts[press + 1]].numpy()
        assert (np.diff(table["frame"][mine]) > 0).all()
        assert set(table["location"][mine].tolist()) == {int(presses.location[press])}
        assert set(table["indenter"][mine].tolist()) == {int(presses.indenter[press])}
    assert torch.equal(presses.of_frame.bincount(), presses.starts.diff())


def test_images_and_labels_are_those_of_their_rows(archive: MarkerArchive) -> None:
    presses = load_presses(archive["dots"], _rows(archive))
    rows, table = presses.rows.numpy(), archive["dots"].table
    assert np.array_equal(presses.images.numpy(), shrink(archive["dots"].packed(rows)))
    assert np.array_equal(presses.wrench.numpy(), table["wrench"][rows, :3].astype(np.float32))
    assert np.array_equal(presses.depth.numpy(), table["depth"][rows])
    assert np.array_equal(presses.phase.numpy(), table["phase"][rows])
    assert np.array_equal(presses.references.numpy(), shrink(archive["dots"].references))
    assert presses.mm_per_px == archive["dots"].mm_per_px


def test_presses_without_a_location_are_told_apart_by_their_target(archive: MarkerArchive) -> None:
    presses = load_presses(archive["dots"], _rows(archive))
    nowhere = presses.location == -1
    assert presses.target[nowhere].tolist() == [2, 3]
    assert presses.starts.diff()[nowhere].tolist() == [5, 5]


def test_packed_masks_are_kept_on_request(archive: MarkerArchive) -> None:
    rows = _rows(archive)[:6]
    presses = load_presses(archive["dots"], rows, form="packed")
    assert np.array_equal(presses.images.numpy(), archive["dots"].packed(rows))
    assert np.array_equal(presses.references.numpy(), archive["dots"].references)


def test_marker_fields_follow_the_truth(archive: MarkerArchive) -> None:
    reported: list[int] = []
    found = load_presses(
        archive["dots"],
        _rows(archive)[:14],
        form="field",
        progress=lambda done, total: reported.append(done),
    )
    assert found.images.shape == (14, 3, 32, 32)
    field, _ = read_fields(archive["dots"], found.rows.numpy())
    down, across = (torch.arange(32) + 0.5) * 15 - 0.5, (torch.arange(32) + 0.5) * 20 - 0.5
    rows, columns = torch.meshgrid(down, across, indexing="ij")
    truth = sampled(field, columns, rows)
    inside = (found.images[:, :2] - truth)[..., 6:-6, 6:-6]
    assert inside.abs().median() < 0.5
    assert truth.abs().max() > 5
    assert reported[-1] == 14
    assert reported == sorted(reported)


def test_presses_without_any_label_are_refused_for_forces_alone(archive: MarkerArchive) -> None:
    load_presses(archive["dots"], _rows(archive)).require_wrench()
    presses = load_presses(archive["grid"], _rows(archive, "grid"))
    with pytest.raises(LearningError, match=r"sensor grid: found no label of Fx, Fy or Fz in"):
        presses.require_wrench()


def test_no_rows_are_no_presses_and_rows_without_a_frame_are_refused(
    archive: MarkerArchive,
) -> None:
    presses = load_presses(archive["dots"], np.array([], np.int64))
    assert (len(presses), presses.frames) == (0, 0)
    with pytest.raises(LearningError, match=r"row 7 is not valid \(missing\)"):
        load_presses(archive["dots"], [7])


def test_a_chunk_that_is_gone_is_an_error(archive: MarkerArchive, tmp_path: Path) -> None:
    path = tmp_path / "broken.markers.zarr"
    shutil.copytree(archive.path, path)
    next((path / "dots/markers").glob("c.1*")).unlink()
    broken = MarkerArchive(path)
    with pytest.raises(SessionError, match="shard missing"):
        load_presses(broken["dots"], _rows(archive))


def test_a_table_of_presses_has_images_without_data(archive: MarkerArchive) -> None:
    rows = _rows(archive)
    described, presses = (read(archive["dots"], rows) for read in (press_table, load_presses))
    assert described.images.is_meta
    assert described.images.shape == presses.images.shape
    assert torch.equal(described.rows, presses.rows)


def test_frames_of_several_sensors_are_read_one_after_another(archive: MarkerArchive) -> None:
    sensors = [archive["dots"], archive["grid"], archive["dots"]]
    rows = [np.array([5, 1, 9]), np.array([], np.int64), np.array([2])]
    counted: list[tuple[int, int]] = []
    images = read_frames_of(sensors, rows, "cpu", lambda done, total: counted.append((done, total)))
    packed = archive["dots"].packed(np.array([5, 1, 9, 2]))
    assert torch.equal(images, torch.from_numpy(shrink(packed)))
    assert [done for done, _ in counted] == sorted(done for done, _ in counted)
    assert (counted[0], counted[-1]) == ((0, 4), (4, 4))


def test_the_fingerprint_changes_with_the_archive(archive: MarkerArchive, tmp_path: Path) -> None:
    first = archive_fingerprint(archive)
    assert first == archive_fingerprint(MarkerArchive(archive.path))
    small: dict[str, Any] = {"targets": 1, "frames_per_phase": 1, "displacement": False}
    prints = []
    for number, stiffness in enumerate((1.0, 1.0, 1.1)):
        path, forces = tmp_path / f"{number}.markers.zarr", {"dots": stiffness}
        made = made_up_archive(path, ("dots",), ("sphere", "cone"), stiffness=forces, **small)
        prints.append(archive_fingerprint(made))
    assert prints[0] == prints[1] != prints[2]
    assert first not in prints


def test_a_range_holds_the_forces_that_it_is_made_from() -> None:
    wrench = torch.tensor([[-1.0, 0.0, -8.0], [1.0, 0.0, 0.0], [0.5, 0.0, -2.0]])
    span = ForceRange.from_training(wrench)
    assert (span.low[0], span.low[2]) == (-1.0, -8.0)
    assert (span.high[0], span.high[2]) == (1.0, 0.0)
    assert span.low[1] == pytest.approx(-span.high[1])
    assert span.high[1] > 0
    assert ForceRange.from_training(wrench, margin=0.1).low[2] == pytest.approx(-8.8)


def test_a_range_is_of_measured_values_alone() -> None:
    span = ForceRange.from_training(
        np.array([[np.nan, np.nan, -8.0], [np.nan, 2.0, np.nan], [np.nan, 1.0, -3.0]])
    )
    assert np.isnan([span.low[0], span.high[0]]).all()
    assert (span.low[1:], span.high[1:]) == ((1.0, -8.0), (2.0, -3.0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_holds_the_same_images(archive: MarkerArchive) -> None:
    rows = _rows(archive)
    here, there = (load_presses(archive["dots"], rows, device=name) for name in ("cpu", "cuda"))
    assert there.images.is_cuda
    assert torch.equal(there.images.cpu(), here.images)
    assert torch.equal(there.to("cpu").wrench, here.wrench)
