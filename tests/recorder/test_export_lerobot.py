"""LeRobot exports, read with pyarrow, and with LeRobot itself if it is installed."""

import io
import json
import os
import subprocess
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from support.sessions import T0, make_session

from recorder import Session, SessionError
from recorder.convert import Answers, Options, export, lerobot_format
from recorder.convert.lerobot_format import (
    document_of,
    of_both,
    read_lerobot,
    statistics_of,
)
from recorder.convert.runs import parse_utc

IMAGE = "observation.images.tactile"
READER = """
import json, sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

data = LeRobotDataset("local/session", root=sys.argv[1])
rows = [data[i] for i in range(len(data))]
names = [name for name in data.features if name != "observation.images.tactile"]
saved = {name: np.stack([row[name].numpy() for row in rows]) for name in names}
if data.meta.camera_keys:
    saved["image"] = np.stack([row["observation.images.tactile"].numpy() for row in rows])
window = LeRobotDataset(
    "local/session", root=sys.argv[1], episodes=[1],
    delta_timestamps={"observation.force": [-1 / data.fps, 0.0]},
)
saved["window"] = np.stack([window[i]["observation.force"].numpy() for i in range(len(window))])
np.savez(sys.argv[2], **saved)
stats = {name: {key: np.shape(v) for key, v in s.items()} for name, s in data.meta.stats.items()}
print(json.dumps({"episodes": data.num_episodes, "fps": data.fps, "task": rows[0]["task"],
                  "stats": stats}))
"""


def columns(path: Path) -> dict[str, Any]:
    table = pa.concat_tables(pq.read_table(file) for file in sorted(path.glob("data/*/*.parquet")))
    return {name: table.column(name).to_pylist() for name in table.column_names}


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, Path]:
    folder = tmp_path_factory.mktemp("lerobot")
    path = make_session(folder / "s.zarr")
    export(path, folder / "d", "lerobot")
    return Session(path), folder / "d"


def test_rows_are_those_of_the_frames_view(both: tuple[Session, Path]) -> None:
    session, path = both
    frames, found = session.frames, columns(path)
    np.testing.assert_array_equal(found["t_ns"], frames["t_ns"])
    captured = session.streams["camera"].t_ns[frames["image"]]
    np.testing.assert_array_equal(found["capture_ns"], captured)
    utc = captured - T0 + parse_utc("2026-01-01T00:00:00Z")
    np.testing.assert_array_equal(found["utc_ns"], utc)
    np.testing.assert_array_equal(found["observation.force"], frames["wrench"].astype(np.float32))
    np.testing.assert_array_equal(found["observation.state"], frames["pose"].astype(np.float32))
    for name in ("phase", "target", "run", "valid"):
        np.testing.assert_array_equal(found[name], frames[name])
    np.testing.assert_array_equal(found["index"], np.arange(len(frames["t_ns"])))


def test_images_are_the_bytes_of_the_camera(both: tuple[Session, Path]) -> None:
    session, path = both
    camera, rows = session.streams["camera"], session.frames["image"].tolist()
    assert [entry["bytes"] for entry in columns(path)[IMAGE]] == [*camera.jpegs(rows)]


def test_an_episode_is_a_press_and_its_actions_are_the_next_poses(
    both: tuple[Session, Path],
) -> None:
    session, path = both
    found = columns(path)
    episodes = pq.read_table(path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["length"] for row in episodes] == [60, 60]
    for number, row in enumerate(episodes):
        part = slice(row["dataset_from_index"], row["dataset_to_index"])
        assert set(found["episode_index"][part]) == {number}
        assert found["frame_index"][part] == list(range(60))
        np.testing.assert_allclose(found["timestamp"][part], np.arange(60) / 40, rtol=1e-6)
        state, action = found["observation.state"][part], found["action"][part]
        assert action == [*state[1:], state[-1]]
        (text,) = row["tasks"]
        assert text == "press the sphere indenter into the wedge sensor and shear it"
    assert set(session.frames["target"]) == {0, 1}


def test_the_metadata_is_that_of_version_3(both: tuple[Session, Path]) -> None:
    session, path = both
    info = json.loads((path / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (40, 2, 120)
    assert info["splits"] == {"train": "0:2"}
    assert info["features"][IMAGE]["dtype"] == "image"
    assert info["features"][IMAGE]["shape"] == [48, 64, 3]
    assert (path / info["data_path"].format(chunk_index=0, file_index=0)).is_file()
    schema = pq.read_schema(path / "data/chunk-000/file-000.parquet")
    described = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    assert set(described) == set(info["features"]) == set(schema.names)
    stats = json.loads((path / "meta/stats.json").read_text())
    wrench = session.frames["wrench"]
    np.testing.assert_allclose(stats["observation.force"]["mean"], wrench.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(stats["observation.force"]["std"], wrench.std(axis=0), atol=1e-9)
    np.testing.assert_allclose(stats["observation.force"]["min"], wrench.min(axis=0))
    assert np.shape(stats[IMAGE]["mean"]) == (3, 1, 1)
    assert 0 < stats[IMAGE]["mean"][0][0][0] < 1
    kept = json.loads((path / "meta/tactile_rig.json").read_text())
    assert kept["contact_frame"] == session.attrs["contact_frame"]


def test_lossless_images_become_lossless_pngs(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("camera", "force"), codec="zstd", seconds=2.0)
    export(path, tmp_path / "d", "lerobot")
    session, found = Session(path), columns(tmp_path / "d")
    for row, entry in zip(session.frames["image"], found[IMAGE], strict=True):
        with Image.open(io.BytesIO(entry["bytes"])) as image:
            assert image.format == "PNG"
            pixels = np.asarray(image)
        np.testing.assert_array_equal(pixels, session.streams["camera"].images([int(row)])[0])
    assert "observation.state" not in found
    assert "action" not in found


def test_taxels_are_a_feature_of_48_and_need_no_image(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("taxels", "pose"))
    export(path, tmp_path / "d", "lerobot")
    taxels = Session(path).frames["taxels"].reshape(-1, 48)
    found = columns(tmp_path / "d")
    np.testing.assert_array_equal(found["observation.taxels"], taxels.astype(np.float32))
    assert IMAGE not in found


def test_files_end_with_an_episode_when_they_are_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot_format, "_FILE_BYTES", 1)
    export(make_session(tmp_path / "s.zarr"), tmp_path / "d", "lerobot")
    episodes = pq.read_table(tmp_path / "d/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["data/file_index"] for row in episodes] == [0, 1]
    for row in episodes:
        file = tmp_path / f"d/data/chunk-000/file-{row['data/file_index']:03d}.parquet"
        assert set(pq.read_table(file).column("episode_index").to_pylist()) == {
            row["episode_index"]
        }


def test_rows_without_an_image_are_left_out_and_invalid_ones_if_asked(tmp_path: Path) -> None:
    def late(name: str, columns: dict[str, Any]) -> dict[str, Any]:
        if name == "camera":  # the first image comes 0.3 s late
            return {key: value[18:] for key, value in columns.items()}
        if name == "force":  # and forces pause for 0.1 s
            keep = np.r_[0:1000, 1100 : len(columns["t_ns"])]
            return {key: np.asarray(value)[keep] for key, value in columns.items()}
        return columns

    path = make_session(tmp_path / "s.zarr", change=late)
    frames = Session(path).frames
    export(path, tmp_path / "all", "lerobot")
    export(path, tmp_path / "valid", "lerobot", options=Options(valid_only=True))
    pictured, valid = int((frames["image"] >= 0).sum()), int(frames["valid"].sum())
    assert len(columns(tmp_path / "all")["index"]) == pictured < len(frames["t_ns"])
    found = columns(tmp_path / "valid")
    assert len(found["index"]) == valid < pictured
    assert all(found["valid"])


def test_a_video_path_that_leaves_the_data_set_is_refused(tmp_path: Path) -> None:
    export(make_session(tmp_path / "s.zarr"), tmp_path / "d", "lerobot")
    (tmp_path / "secret.mp4").write_bytes(b"")
    file = tmp_path / "d/meta/info.json"
    info = json.loads(file.read_text())
    info["features"]["cam"] = {"dtype": "video", "shape": [48, 64, 3]}
    answers = Answers(units="N", torque_units="N m", kinds=(f"{IMAGE}=skip",))
    for template in ("../secret.mp4", str(tmp_path / "secret.mp4"), "{video_key}/../../secret.mp4"):
        file.write_text(json.dumps({**info, "video_path": template}))
        with pytest.raises(SessionError, match=r"video_path: .*secret.mp4 is outside of the data"):
            read_lerobot(tmp_path / "d", answers)
    file.write_text(json.dumps({**info, "fps": 0}))
    with pytest.raises(SessionError, match=r"fps: found 0 Hz; allowed: 0\.001 to 100000"):
        read_lerobot(tmp_path / "d", answers)


def test_statistics_of_parts_are_those_of_the_whole() -> None:
    values = np.random.default_rng(1).normal(3, 2, (1000, 3))
    values[17, 1] = np.nan
    parts = [statistics_of(part) for part in np.split(values, [100, 130, 700])]
    first, second = document_of(statistics_of(values)), document_of(reduce(of_both, parts))
    for key in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(second[key], first[key], rtol=1e-12)
    np.testing.assert_allclose(second["q50"], first["q50"], atol=0.3)
    assert second["count"] == [999]


@pytest.mark.slow
@pytest.mark.parametrize("names", [("camera", "force", "pose"), ("taxels", "force", "pose")])
def test_lerobot_itself_reads_it(names: tuple[str, ...], tmp_path: Path) -> None:
    python = os.environ.get("LEROBOT_PYTHON")
    if not python:
        pytest.skip("needs LEROBOT_PYTHON, an interpreter with lerobot 0.4 or newer")
    path = make_session(tmp_path / "s.zarr", names=names)
    export(path, tmp_path / "d", "lerobot")
    (tmp_path / "read.py").write_text(READER)
    environment = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    done = subprocess.run(
        [python, "read.py", "d", "seen.npz"],
        cwd=tmp_path,
        env={**os.environ, **environment, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    reported = json.loads(done.stdout.splitlines()[-1])
    assert (reported["episodes"], reported["fps"]) == (2, 40)
    assert reported["task"] == "press the sphere indenter into the wedge sensor and shear it"
    session, seen = Session(path), np.load(tmp_path / "seen.npz")
    frames = session.frames
    np.testing.assert_array_equal(seen["t_ns"], frames["t_ns"])
    np.testing.assert_array_equal(seen["observation.force"], frames["wrench"].astype(np.float32))
    np.testing.assert_array_equal(seen["observation.state"], frames["pose"].astype(np.float32))
    second = frames["wrench"][60:].astype(np.float32)
    np.testing.assert_array_equal(seen["window"][1:], np.stack([second[:-1], second[1:]], axis=1))
    if "camera" in names:
        pixels = session.streams["camera"].images(frames["image"])
        found = np.round(seen["image"].transpose(0, 2, 3, 1) * 255).astype(int)
        # Two JPEG decoders may differ by a grey level or two.
        assert np.abs(found - pixels).max() <= 4
        assert reported["stats"][IMAGE]["mean"] == [3, 1, 1]
    else:
        taxels = frames["taxels"].reshape(-1, 48).astype(np.float32)
        np.testing.assert_array_equal(seen["observation.taxels"], taxels)
