"""Windows of sessions and archives as a data set for PyTorch."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from support.made_up_archives import archive_of
from support.sessions import make_session, reseal, set_attrs
from torch.utils.data import DataLoader

from learning.data import dataset
from learning.data.dataset import TactileDataset
from learning.errors import LearningError
from recorder import MarkerArchive, Session, SessionError

ROOT = Path(__file__).parents[2]
ROWS = 6


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions")
    for name, indenter in (("a", "sphere"), ("b", "torus"), ("c", "prism")):
        path = make_session(folder / f"{name}.zarr", seconds=1.2)
        set_attrs(path, indenter=indenter)
        reseal(path)
    return folder


archive = archive_of()


def test_a_window_has_the_values_of_its_session(sessions: Path) -> None:
    windows = TactileDataset(sessions, ROWS)
    assert [Path(path).name for path in windows.paths] == ["a.zarr", "b.zarr", "c.zarr"]
    assert windows.streams == ("image", "wrench", "pose")
    for number in (0, 17, len(windows) - 1):
        sample = windows[number]
        session = Session(windows.paths[int(sample["recording"])])
        end = int(session.frames["t_ns"][int(sample["row"])])
        found = session.window(end, ROWS)
        assert found.image is not None
        assert found.wrench is not None
        assert sample["image"].shape == (ROWS, 3, 48, 64)
        np.testing.assert_array_equal(sample["image"].numpy(), np.moveaxis(found.image, -1, 1))
        np.testing.assert_array_equal(sample["wrench"].numpy(), found.wrench.astype(np.float32))
        np.testing.assert_array_equal(sample["t_ns"].numpy(), found.t_ns)
        np.testing.assert_array_equal(sample["valid"].numpy(), found.valid)
    assert torch.equal(windows[-1]["t_ns"], windows[len(windows) - 1]["t_ns"])
    with pytest.raises(IndexError, match=f"no window {len(windows)}"):
        windows[len(windows)]


def test_a_window_begins_in_the_run_that_it_ends_in(sessions: Path) -> None:
    windows = TactileDataset(sessions / "a.zarr", ROWS)
    start = Session(sessions / "a.zarr").frames["t_ns"].min()
    assert min(int(windows[number]["t_ns"][0]) for number in range(len(windows))) == start
    assert len(windows) == len(Session(sessions / "a.zarr").frames["t_ns"]) - ROWS + 1
    assert len(TactileDataset(sessions / "a.zarr", ROWS, stride=4)) == -(-len(windows) // 4)


def test_parts_have_different_indenters(sessions: Path) -> None:
    parts = {part: TactileDataset(sessions, ROWS, split=part) for part in ("train", "test")}
    names = {part: [Path(path).stem for path in each.paths] for part, each in parts.items()}
    assert names == {"train": ["a", "c"], "test": ["b"]}
    assert sum(len(each) for each in parts.values()) == len(TactileDataset(sessions, ROWS))


def test_a_string_is_one_name_and_an_unknown_one_is_refused(sessions: Path) -> None:
    kept = TactileDataset(sessions, ROWS, split="train", unseen="sphere", streams="wrench")
    assert [Path(path).stem for path in kept.paths] == ["b", "c"]
    assert kept.streams == ("wrench",)
    chosen = TactileDataset(sessions, ROWS, indenter=["prism", "torus"], sensor="wedge", mock=True)
    assert [Path(path).stem for path in chosen.paths] == ["b", "c"]
    for key, known in (("unseen", "wave"), ("indenter", "prism, sphere, torus"), ("sensor", "w")):
        with pytest.raises(LearningError, match=rf"{key}: found 'sfere'; known: .*{known}"):
            TactileDataset(sessions, ROWS, **{key: "sfere"})  # type: ignore[arg-type]
    with pytest.raises(LearningError, match="no window of 6 rows in 0 of 3 recordings"):
        TactileDataset(sessions, ROWS, mock=False)


def test_sensors_are_not_mixed_and_presses_of_a_set_up_are_left_out(tmp_path: Path) -> None:
    for name, attrs in (
        ("data", {"plan": {"kind": "press_shear"}}),
        ("touch", {"plan": {"kind": "touch"}}),
        ("latency", {"plan": {"kind": "taps"}}),
        ("other", {"sensor": "digit"}),
    ):
        path = make_session(tmp_path / f"{name}.zarr", seconds=1.2, names=("force",))
        set_attrs(path, **attrs)
        reseal(path)
    with pytest.raises(LearningError, match=r"found sensors digit, wedge; allowed: one, or those"):
        TactileDataset(tmp_path, 2)
    assert [Path(path).stem for path in TactileDataset(tmp_path, 2, sensor="wedge").paths] == [
        "data"
    ]
    assert len(TactileDataset(tmp_path, 2, sensor=["wedge", "digit"]).paths) == 2
    # One that is named is read: it was asked for.
    assert len(TactileDataset(tmp_path / "touch.zarr", 2)) > 0


def test_val_has_whole_presses_that_train_has_no_row_of(
    tmp_path: Path, archive: MarkerArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_session(tmp_path / "s.zarr", seconds=8.4, names=("force",))
    frames = Session(path).frames
    t_ns, target = np.asarray(frames["t_ns"]), np.asarray(frames["target"])
    shown: dict[str, set[int]] = {}
    for part in ("train", "val"):
        times = [one["t_ns"] for one in TactileDataset(path, ROWS, split=part)]  # type: ignore[arg-type]
        inside = [(t_ns >= int(of[0]) - 1000) & (t_ns <= int(of[-1])) for of in times]
        shown[part] = set(target[np.any(inside, axis=0)].tolist())
    assert shown["val"] == {4}
    assert shown["train"] == {0, 1, 2, 3}
    monkeypatch.setattr(dataset, "ONE_IN", 3)
    locations = []
    for sensor in ("dots", "grid"):
        parts = [
            TactileDataset(f"{archive.path}:{sensor}", 3, split=part, unseen="cone")
            for part in ("train", "val", "test")
        ]
        of = archive[sensor].table["location"]
        locations.append([{int(of[int(one["row"])]) for one in part} for part in parts])
        assert sum(map(len, parts)) == len(TactileDataset(f"{archive.path}:{sensor}", 3))
    assert locations[0] == locations[1]
    assert all(locations[0])
    assert not locations[0][0] & locations[0][1]


def test_a_transform_is_applied_to_each_sample(sessions: Path) -> None:
    windows = TactileDataset(
        sessions, ROWS, transform=lambda sample: {"fz": sample["wrench"][-1, 2]}
    )
    fz = TactileDataset(sessions, ROWS)[3]["wrench"][-1, 2]
    assert windows[3] == {"fz": fz}
    assert next(iter(DataLoader(windows, batch_size=4)))["fz"].shape == (4,)


@pytest.mark.parametrize("workers", [0, 2])
def test_batches_of_an_epoch_are_the_same_for_any_workers_and_go_on_where_they_stopped(
    sessions: Path, workers: int
) -> None:
    windows = TactileDataset(sessions, ROWS, streams=["wrench"], stride=3)

    def read(first: int, workers: int = workers, epoch: int = 1) -> list[list[tuple[int, int]]]:
        made = windows.batches(4, seed=3, epoch=epoch, first=first)
        loader = DataLoader(made, batch_size=None, num_workers=workers)
        return [
            list(zip(batch["recording"].tolist(), batch["row"].tolist(), strict=True))
            for batch in loader
        ]

    whole = read(0)
    assert whole == read(0, workers=0)
    assert whole[5:] == read(5)
    assert whole != read(0, workers=0, epoch=2)
    used = [window for batch in whole for window in batch]
    assert len(used) == len(set(used)) == len(windows)
    assert len(whole) == len(windows.batches(4)) == -(-len(windows) // 4)


def test_only_some_recordings_are_open(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "OPEN", 2)
    windows = TactileDataset(sessions, ROWS, streams=["wrench"])
    for number in range(0, len(windows), 5):
        windows[number]
        assert len(windows._open) <= 2


def test_windows_of_an_archive_stay_within_a_press(archive: MarkerArchive) -> None:
    windows = TactileDataset(f"{archive.path}:dots", 3)
    sensor = archive["dots"]
    of = sensor.table["location"]
    for number in range(0, len(windows), 7):
        sample = windows[number]
        row = int(sample["row"])
        assert of[row - 2] == of[row] >= 0
        masks = sensor.masks(np.arange(row - 2, row + 1))
        assert torch.equal(sample["image"][:, 0] > 0, torch.from_numpy(masks))
        assert sample["image"].unique().tolist() == [0, 255]
        np.testing.assert_allclose(
            sample["wrench"].numpy(), sensor.table["wrench"][row - 2 : row + 1], rtol=1e-6
        )
    held = TactileDataset(f"{archive.path}:dots", 3, split="test", unseen=["cone"])
    codes = {int(sensor.table["indenter"][int(one["row"])]) for one in held}
    assert {archive.indenters[code] for code in codes} == {"cone"}
    with pytest.raises(LearningError, match="no such sensor; allowed: dots, grid"):
        TactileDataset(f"{archive.path}:squares")


def test_what_makes_no_sense_is_refused(sessions: Path, tmp_path: Path) -> None:
    for wrong in (0, 2.5, True, "3"):
        with pytest.raises(LearningError, match=rf"window: found {wrong!r}; allowed: a whole num"):
            TactileDataset(sessions, wrong)  # type: ignore[arg-type]
    with pytest.raises(LearningError, match="split: found 'new'; allowed: train, val, test, None"):
        TactileDataset(sessions, split="new")  # type: ignore[arg-type]
    with pytest.raises(LearningError, match="found no window of 999 rows in 3 of 3 recordings"):
        TactileDataset(sessions, 999)
    with pytest.raises(LearningError, match=r"nowhere: no such folder; allowed: sessions"):
        TactileDataset(tmp_path / "nowhere")
    with pytest.raises(LearningError, match=r"no column 'taxels'; known: image, wrench, pose"):
        TactileDataset(sessions, ROWS, streams=["taxels"])
    with pytest.raises(LearningError, match="size, first: found 0, 0"):
        TactileDataset(sessions, ROWS).batches(0)
    nameless = make_session(tmp_path / "12:30 n.zarr", seconds=0.9, names=("force",))
    set_attrs(nameless, indenter=None)
    reseal(nameless)
    with pytest.raises(LearningError, match=r"n\.zarr: names no indenter"):
        TactileDataset(nameless, 2, split="train")
    assert len(TactileDataset(nameless, 2)) > 0
    make_session(tmp_path / "live.zarr", seconds=0.6, names=("force",), finish=False)
    with pytest.raises(SessionError, match=r"live\.zarr: recording, so it has no frames yet"):
        TactileDataset(tmp_path, 2)
    (tmp_path / "live.zarr" / "zarr.json").write_text("{")
    with pytest.raises(SessionError, match=r"live\.zarr"):
        TactileDataset(tmp_path, 2)


def test_the_python_of_the_guide_runs(
    sessions: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sessions").symlink_to(sessions)
    text = (ROOT / "docs/how-to/train-in-pytorch.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.S)
    assert len(blocks) == 2
    known: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "guide", "exec"), known)
