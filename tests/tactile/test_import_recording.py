"""`tactile import` recognises files, asks for the unknown, and never guesses."""

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import simplejpeg
from PIL import Image

from learning.data.matching import SensorSelection, read_presses
from recorder import MarkerArchive, Session, check, faults
from recorder.archive import SHADING_ZERO
from recorder.convert.import_clocks import find_clock
from recorder.convert.import_presses import Signal
from recorder.convert.import_tracks import MissingAnswer
from tactile.__main__ import main

pytestmark = pytest.mark.slow

FPS, COUNT = 30, 60
TIMES = np.arange(COUNT) / FPS


def pressing(seed: int = 0, times: np.ndarray = TIMES) -> np.ndarray:
    """Return a pressing force (n,) [N]: one contact from about 0.5 to 1.5 s, and noise."""
    shape = np.clip(np.sin(np.pi * (times - 0.5 - 0.02 * seed)), 0, None) * (times < 1.6)
    noise = np.random.default_rng(seed).normal(0, 0.005, len(times))
    return 5.0 * shape + noise


def pictures(force: np.ndarray, seed: int = 0, gain: float = 8.0) -> list[np.ndarray]:
    """Return pictures (60, 80, 3) of a gel without markers that reddens where it is pressed."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:60, :80]
    spot = np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 200)
    base = np.stack([90 + x / 4, 100 + y / 4, 110 - x / 8], axis=-1)
    return [
        np.clip(
            base + gain * f * spot[..., None] * [1, 0.3, -0.5] + random.normal(0, 1, base.shape),
            0,
            255,
        ).astype(np.uint8)
        for f in np.maximum(force, 0)
    ]


def write_frames(folder: Path, images: list[np.ndarray]) -> Path:
    folder.mkdir(parents=True)
    for number, image in enumerate(images):
        (folder / f"{number:03}.jpg").write_bytes(simplejpeg.encode_jpeg(image, quality=95))
    return folder


def grasps(folder: Path) -> Path:
    """Write four recordings of two objects: folders of images with a force file each."""
    for number, name in enumerate(("ball_1", "ball_2", "cube_1", "cube_2")):
        force = pressing(number)
        write_frames(folder / name, pictures(force, number))
        np.save(folder / f"{name}_forces.npy", force)
    (folder / "README.md").write_text("no recording")
    return folder


def uskin(seed: int, count: int = 90) -> np.ndarray:
    """Return counts (n, 16, 3): axes rest far apart, taxel 5 is pressed in the middle."""
    random = np.random.default_rng(seed)
    resting = np.array([33_000.0, 34_500.0, 21_000.0]) + random.normal(0, 300, (16, 3))
    counts = resting + random.normal(0, 2, (count, 16, 3))
    counts[30:60, 5, 2] += 3_000 * np.sin(np.pi * np.arange(30) / 30)
    return np.rint(counts)


STATED = ["--sensor", "gel", "--indenter", "ball", "--yes"]


def run(*words: Any) -> int:
    return main([str(word) for word in words])


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    def call(*words: Any) -> str:
        assert run(*words) == 2
        return capsys.readouterr().err

    return call


def test_from_folders_to_scores_on_the_object_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three commands: import, markers, force; then `--like` needs no answer again."""
    source, out = grasps(tmp_path / "in"), tmp_path / "gel"
    answers = ["--sensor", "gel", "--by-name", "--units", "N", "--fps", FPS]
    assert run("import", source, "--out", out, *answers, "--yes") == 0
    told = capsys.readouterr().out
    assert "4 recordings, 4 presses, 2 sessions" in told
    assert "no press can be joined" in told
    sessions = [out / "ball.zarr", out / "cube.zarr"]
    for path in sessions:
        assert faults(check(path)) == []
        session = Session(path)
        assert len(session.runs) == 2
        assert np.isnan(session.targets["depth"]).all()
        assert session.attrs["imported"]["place"] == "unknown"
        assert session.frames["wrench"][:, 2].min() == pytest.approx(-5.0, abs=0.1)
    archive = tmp_path / "gel.markers.zarr"
    named = f"{sessions[0]} {sessions[1]}"
    asked = f"markers {named} --preset PRESET --mm-per-px MM --out {archive}"
    assert f"next: tactile {asked}\nPRESET: shading for a gel without markers" in told
    words = ["--preset", "shading", "--mm-per-px", "0.03", "--out", archive]
    assert run("markers", *sessions, *words, "--sheet", tmp_path / "s.png") == 0
    assert faults(check(archive)) == []
    sensor = MarkerArchive(archive)["gel"]
    assert len(np.unique(sensor.table["location"])) == 4
    assert sensor.attrs["position"].startswith("unknown")
    hardest = int(np.argmin(sensor.table["wrench"][:, 2]))
    assert sensor.frames([hardest])[0, 0].max() > SHADING_ZERO + 25
    with pytest.raises(Exception, match="holds shading, not masks"):
        sensor.masks([0])
    model = tmp_path / "model"
    assert run("force", "--sensor", archive, "--ways", "ridge", "--out", model) == 0
    told = capsys.readouterr().out
    assert "R2 on indenters left out: Fz " in told
    assert "90 % not guaranteed: 2 indenters" in told
    assert (model / "forces.png").stat().st_size > 1000
    assert run("import", source, "--out", tmp_path / "b", "--like", sessions[0], "--yes") == 0
    joined = tmp_path / "j.markers.zarr"
    assert run("archive", "join", archive, f"{archive}:gel=other", "--out", joined) == 2
    assert "unknown" in capsys.readouterr().err


def test_what_a_recording_cannot_tell_is_asked_for_by_its_option(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    source, out = grasps(tmp_path / "in"), tmp_path / "x"
    given: list[Any] = ["import", source, "--out", out]
    for option, answer in (
        ("--fps", ["--fps", FPS]),
        ("--units", ["--units", "N"]),
        ("--sensor", ["--sensor", "gel"]),
        ("--indenter", ["--by-name"]),
        ("repeat with --yes", []),
    ):
        assert option in refused(*given)
        given += answer
    assert not out.exists()
    page = (tmp_path / "x.import.html").read_text()
    assert "ball_1: ball" in page
    assert page.count("data:image/png") > 8
    assert "--out: found" in refused(*given[:2], "--out", tmp_path / "x.zarr", *given[4:], "--yes")


def test_an_answer_at_the_terminal_takes_the_place_of_the_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "taxels.npy"
    np.save(path, uskin(0).reshape(-1, 48))
    typed = iter(["60", "skin", "ball", "y"])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda _: next(typed))
    assert run("import", path, "--out", tmp_path / "x.zarr") == 0
    session = Session(tmp_path / "x.zarr")
    assert (session.attrs["sensor"], session.attrs["indenter"]) == ("skin", "ball")
    assert session.attrs["imported"]["answers"]["taxels_hz"] == ["60"]


@pytest.mark.parametrize("layout", ["taxel", "axis"])
def test_taxels_come_out_in_one_order_and_the_next_command_makes_an_archive_of_their_presses(
    layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    counts = uskin(1)
    flat = counts if layout == "taxel" else counts.transpose(0, 2, 1)
    folder = tmp_path / "first day"  # whose name must be quoted in a command
    folder.mkdir()
    np.save(folder / "taxels.npy", flat.reshape(-1, 48).astype(np.float32))
    out, archive = folder / "x.zarr", folder / "x.markers.zarr"
    assert run("import", folder, "--out", out, "--taxels-hz", "60", *STATED) == 0
    session = Session(out)
    assert faults(check(out)) == []
    assert np.array_equal(session.streams["taxels"].array("value"), counts)
    start, end = session.segments["start_ns"].min(), session.segments["end_ns"].max()
    assert start * 60e-9 == pytest.approx(30, abs=4)
    assert end * 60e-9 == pytest.approx(60, abs=4)
    following = shlex.split(capsys.readouterr().out.splitlines()[-1].removeprefix("next: "))
    words = ["tactile", "markers", str(out), "--preset", "uskin"]
    assert following == [*words, "--out", str(archive)]
    assert run(*following[1:]) == 0
    with pytest.raises(Exception, match="cannot be matched"):  # to presses of another sensor
        read_presses(SensorSelection(MarkerArchive(archive), "gel", "gel"))


def test_a_recording_that_ends_in_contact_is_refused_until_told(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    counts = uskin(2)
    counts[45:] = counts[45]
    for name, rows in (("ends_in_contact", counts), ("returns", uskin(2))):
        np.save(tmp_path / f"{name}.npy", rows.reshape(-1, 48))
    words = ["import", tmp_path, "--out", tmp_path / "x.zarr", "--taxels-hz", "60", *STATED]
    told = refused(*words)
    assert "ends_in_contact: change of the taxels [counts]: the recording ends" in told
    assert "say --no-contact (ends_in_contact=0.00:" in told
    assert run(*words, "--no-contact", "ends_in_contact=0:0.3") == 0


def test_the_lag_of_a_force_file_is_found_with_its_interval_and_taken_out(tmp_path: Path) -> None:
    late = 0.2
    write_frames(tmp_path / "images", pictures(pressing(times=TIMES - late)))
    at = np.arange(200) / 100
    lines = "".join(f"{t},{-f}\n" for t, f in zip(at, pressing(1, at), strict=True))
    (tmp_path / "force.csv").write_text("t_s,Fz (N)\n" + lines)
    out = tmp_path / "x.zarr"
    assert run("import", tmp_path, "--out", out, "--fps", FPS, "--trim", *STATED) == 0
    told = next(line for line in Session(out).attrs["imported"]["assumed"] if ": lag " in line)
    found = float(told.partition("lag ")[2].split(" ms")[0])
    assert found == pytest.approx(1e3 * (late - 0.02), abs=25)
    moved = Session(out).streams["force"].t_ns[0] * 1e-6
    assert moved == pytest.approx(found, abs=1)


def test_a_flat_signal_has_no_lag() -> None:
    times = (np.arange(60) * 1e9 / 30).astype(np.int64)
    noise = np.random.default_rng(0).normal(0, 1, (60, 1))
    for force in (np.ones((60, 1)), np.roll(noise[::-1], 7, axis=0)):
        with pytest.raises(MissingAnswer, match=r"--lag \(SECONDS or 0 if they started together\)"):
            find_clock(Signal("image", times, noise), Signal("force", times, force), "x")


def test_forces_that_rise_under_contact_are_refused(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    force = pressing()
    write_frames(tmp_path / "images", pictures(force))
    np.save(tmp_path / "force.npy", np.stack([0 * force, 0 * force, force], axis=1))
    words = ["import", tmp_path, "--out", tmp_path / "x.zarr", "--fps", FPS, "--units", "N"]
    assert "turn the sign of the file's forces" in refused(*words, *STATED)
    assert "Fz rises to +4.99 N" in refused(*words, *STATED, "--no-contact", "0:0.3")


def test_single_pictures_are_contacts_of_their_own(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number, image in enumerate(pictures(np.array([0.0, 3.0, 5.0]))):
        Image.fromarray(image).save(folder / f"p{number}.png")
    out = tmp_path / "x.zarr"
    words = ["import", folder, "--out", out, *STATED]
    assert "--stills if each picture" in refused(*words)
    assert "say --no-contact (p0.png or p1.png or p2.png)" in refused(*words, "--stills")
    assert run(*words, "--stills", "--no-contact", "p0.png") == 0
    session = Session(out)
    assert faults(check(out)) == []
    assert session.frames["image"].tolist() == [1, 2]
    assert session.reference["image"].tolist() == [0]


def test_a_log_of_the_uskin_server_is_read_by_its_own_times(tmp_path: Path) -> None:
    counts = uskin(3)
    with (tmp_path / "uskin.jsonl").open("w") as file:
        for row, scan in enumerate(counts.astype(int)):
            words = ",".join(f"{value:04X}" for value in scan.reshape(-1))
            file.write(json.dumps({"time": 100 + row / 60, "1": {"data": words}}) + "\n")
    out = tmp_path / "x.zarr"
    assert run("import", tmp_path, "--out", out, *STATED) == 0
    assert np.array_equal(Session(out).streams["taxels"].array("value"), counts)


def test_an_npz_and_a_csv_become_streams(tmp_path: Path, refused: Callable[..., str]) -> None:
    force = pressing()
    write_frames(tmp_path / "a" / "images", pictures(force))
    np.savez(
        tmp_path / "a" / "data.npz", force=force, gripper_width=0.05 - 0.001 * force, odd=force
    )
    words = ["import", tmp_path / "a", "--fps", FPS, "--units", "N", *STATED]
    words += ["--width-unit", "m", "--out", tmp_path / "x.zarr"]
    assert "say --as (data.npz:odd=force" in refused(*words)
    assert run(*words, "--as", "odd=values") == 0
    session = Session(tmp_path / "x.zarr")
    assert session.order == ["camera", "force", "width", "values"]
    assert faults(check(session.path)) == []
    pose = "t_s,Fz (N),X (m),Y (m),Z (mm),RX (rad),RY (rad),RZ (rad)\n"
    rows = zip(TIMES, force, strict=True)
    pose += "".join(f"{t},{-f},0.1,0.2,{10 - max(f, 0) / 5},0,0,0\n" for t, f in rows)
    (tmp_path / "log.csv").write_text(pose)
    frame = ["--contact-frame", "0.1,0.2,0.01,0,0,0", "--out", tmp_path / "y.zarr"]
    assert run("import", tmp_path / "log.csv", *frame, *STATED) == 0
    session = Session(tmp_path / "y.zarr")
    assert session.targets["depth"] == pytest.approx([1e-3], abs=2e-5)
    assert faults(check(session.path)) == []


def _rosbag(version: int, folder: Path, force: np.ndarray, *, mcap: bool = False) -> Path:
    """Write a rosbag; `mcap` returns the one MCAP file of CDR messages in a rosbag 2."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    path = folder / ("x.bag" if version == 1 else "x")
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    writer: Any = Writer1(path) if version == 1 else Writer2(path, version=8, storage_plugin=plugin)
    serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr
    with writer:
        topics = {
            "/camera": "sensor_msgs/msg/CompressedImage",
            "/ft": "geometry_msgs/msg/WrenchStamped",
        }
        opened = {
            name: writer.add_connection(name, kind, typestore=store)
            for name, kind in topics.items()
        }
        vector = types["geometry_msgs/msg/Vector3"]
        for row, image in enumerate(pictures(force)):
            t_ns = 10**18 + round(1e9 * row / FPS)
            stamp = types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
            seq = {"seq": row} if version == 1 else {}
            head = types["std_msgs/msg/Header"](stamp=stamp, frame_id="x", **seq)
            data = np.frombuffer(simplejpeg.encode_jpeg(image, quality=95), np.uint8)
            picture = types[topics["/camera"]](head, "jpeg", data)
            wrench = types["geometry_msgs/msg/Wrench"](
                vector(0.0, 0.0, -float(force[row])), vector(0.0, 0.0, 0.0)
            )
            for name, message in (
                ("/camera", picture),
                ("/ft", types[topics["/ft"]](head, wrench)),
            ):
                # Logged late: the message's own stamp is its time.
                writer.write(opened[name], t_ns + 5_000_000, serialize(message, topics[name]))
    if not mcap:
        return path
    (file,) = path.glob("*.mcap")
    return file.rename(folder / "alone.mcap")


KINDS = ["rosbag1", "rosbag2", "mcap", "mcap-cdr", "lerobot", "lerobot-mp4"]


@pytest.mark.parametrize("kind", KINDS)
def test_bags_and_data_sets_become_the_session_that_they_hold(kind: str, tmp_path: Path) -> None:
    force = pressing()
    out = tmp_path / "x.zarr"
    if kind.startswith("rosbag") or kind == "mcap-cdr":
        pytest.importorskip("rosbags")
        pytest.importorskip("mcap")
        path = _rosbag(1 if kind == "rosbag1" else 2, tmp_path, force, mcap=kind == "mcap-cdr")
    else:
        pytest.importorskip("mcap" if kind == "mcap" else "pyarrow")
        path = _exported(kind, tmp_path, force)
    assert run("import", path, "--out", out, "--units", "N", "--torque-units", "N m", *STATED) == 0
    session = Session(out)
    assert faults(check(out)) == []
    if kind == "lerobot-mp4":
        shown = session.streams["camera"].images([3])[0].astype(float)
        assert np.abs(shown - pictures(force)[3]).mean() < 8
    else:
        assert session.streams["camera"].jpeg(3) is not None
    # LeRobot keeps times as float32.
    assert np.diff(session.streams["camera"].t_ns) == pytest.approx(1e9 / FPS, abs=200)
    found = session.streams["force"].array("value")[:, 2]
    assert found == pytest.approx(-force[: len(found)], abs=1e-5)
    assert len(session.targets["depth"]) == 1


def _exported(kind: str, folder: Path, force: np.ndarray) -> Path:
    """Write a file of another tool: an MCAP with JSON, or a LeRobot data set with image bytes."""
    jpegs = [simplejpeg.encode_jpeg(image, quality=95) for image in pictures(force)]
    if kind == "mcap":
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
        from mcap.writer import Writer
        from mcap_protobuf.schema import build_file_descriptor_set

        path = folder / "x.mcap"
        with path.open("wb") as file:
            writer: Any = Writer(file)
            writer.start()
            document = build_file_descriptor_set(CompressedImage).SerializeToString()
            schema = writer.register_schema("foxglove.CompressedImage", "protobuf", document)
            camera = writer.register_channel("/camera", "protobuf", schema)
            schema = writer.register_schema("Wrench", "jsonschema", b"{}")
            wrench = writer.register_channel("/ft", "json", schema)
            for row, data in enumerate(jpegs):
                t_ns = 10**18 + round(1e9 * row / FPS)
                image = CompressedImage(data=data, format="jpeg")
                image.timestamp.FromNanoseconds(t_ns)
                writer.add_message(camera, t_ns, image.SerializeToString(), t_ns)
                zero = {"x": None, "y": None, "z": -float(force[row])}
                message = {"force": zero, "torque": {"x": None, "y": None, "z": None}}
                writer.add_message(wrench, t_ns, json.dumps(message).encode(), t_ns)
            writer.finish()
        return path
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = folder / "x"
    (path / "meta").mkdir(parents=True)
    (path / "data" / "chunk-000").mkdir(parents=True)
    film = kind == "lerobot-mp4"
    camera = "observation.images.tactile"
    info = {
        "fps": FPS,
        "chunks_size": 1000,
        "video_path": "videos/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {
            camera: {"dtype": "video" if film else "image", "shape": [60, 80, 3]},
            "observation.force": {"dtype": "float32", "shape": [6]},
            "action": {"dtype": "float32", "shape": [6]},
            "episode_index": {"dtype": "int64", "shape": [1]},
        },
    }
    (path / "meta" / "info.json").write_text(json.dumps(info))
    rows = {
        camera: [{"bytes": each, "path": None} for each in jpegs],
        "observation.force": [[0.0, 0.0, -float(each), 0.0, 0.0, 0.0] for each in force],
        "timestamp": TIMES.astype(np.float32).tolist(),
        "episode_index": [0] * COUNT,
    }
    if film:
        del rows[camera]
        file = path / "videos" / camera / "episode_000000.mp4"
        file.parent.mkdir(parents=True)
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (80, 60))
        for image in pictures(force):
            writer.write(image[..., ::-1])
        writer.release()
    pq.write_table(pa.table(rows), path / "data" / "chunk-000" / "file-000.parquet")
    return path
