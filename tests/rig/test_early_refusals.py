"""Mistakes are found before a device, an emulator or a page starts; then, devices that are dead."""

import re
import socket
from pathlib import Path

import numpy as np
import pytest
from support.collecting import move_typed
from support.commands import python

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from rig.acquire import collector
from rig.cli.options import free_path
from rig.core.packaged import BENCHES
from rig.mock import bench as mock_bench
from tactile.__main__ import main


@pytest.fixture(autouse=True)
def nothing_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail if a stream or an emulator is started."""

    def started(*_: object, **__: object) -> None:
        raise AssertionError("a device or an emulator was started")

    monkeypatch.setattr(collector, "Streams", started)
    monkeypatch.setattr(mock_bench.MockBench, "__enter__", started)


@pytest.fixture(name="folder")
def folder_of_recordings(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    np.save(tmp_path / "taxels.npy", np.zeros((4, 48)))
    (tmp_path / "old.zarr").mkdir()
    lab = "mock: false\nworld: null\n"
    (tmp_path / "lab.yaml").write_text(f"extends: {BENCHES / 'tacpalm.yaml'}\n{lab}")
    return tmp_path


def test_a_busy_port_is_found_early(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        out = str(folder / "s.zarr")
        assert main(["collect", "--sensor", "tacpalm", "--out", out, "--watch", str(port)]) == 2
    assert f"127.0.0.1:{port}: Address already in use" in capsys.readouterr().err


@pytest.mark.slow
def test_mistakes_are_found_before_anything_slow_is_imported(folder: Path) -> None:
    code = """
import sys
from tactile.__main__ import main
codes = [main(words.split()) for words in sys.argv[1:]]
slow = {"cv2", "matplotlib", "scipy", "sim", "skimage", "torch", "warp"} & set(sys.modules)
print(codes, sorted(slow))
"""
    mistakes = (
        f"collect --sensor tacpalm --out {folder}/old.zarr",
        "live --sensor tacpalm --model nope",
    )
    assert python("-c", code, *mistakes).stdout.splitlines()[-1] == "[2, 2] []"


def test_a_default_name_that_is_taken_gets_a_number(tmp_path: Path) -> None:
    path = tmp_path / "tacpalm-cone-20260101-120000.zarr"
    assert free_path(path) == path
    path.mkdir()
    second = tmp_path / "tacpalm-cone-20260101-120000-2.zarr"
    assert free_path(path) == second
    second.mkdir()
    assert free_path(path).name.endswith("-3.zarr")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("contact_frame: {position_mm: [-0.120, -0.430, 0.160]}", "is it in m?"),
        ("arm: {tcp: {position_mm: [0.0, 0.0, 0.1124]}}", "tcp.position_mm: found [0.0, 0.0, 0.11"),
        ("arm: {speed_mm_s: 0.005}", "is it in m/s? then write 5"),
        ("arm: {payload_kg: 620.0}", "is it in g? then write 0.62"),
        ("tool_rotation_deg: [3.14159, 0.0, 0.0]", "is it in rad? then write 180 deg"),
        ("tool_rotation_deg: [0.0, 0.0, 180.0]", "does not point the tool into the sensor"),
        ("trajectory: {angle_step_deg: 0.7854}", "is it in rad? then write 45"),
        ("trajectory: {depth_max_mm: 0.0045}", "is it in m? then write 4.5"),
        ("limits: {stale_force_ms: 0.05}", "is it in s? then write 50"),
        ("limits: {torque_rating_n_mm: [0.12, 0.12, 0.12]}", "is it in N m?"),
        ("limits: {box_x_mm: [-0.01, 0.01]}", "is it in m?"),
        ("camera: {kind: v4l2, exposure_ms: 1560.0}", "exposure_ms: 1560; allowed: up to 33.33"),
        ("camera: {exposure_ms: 15.6}", "camera: unknown exposure_ms with kind mjpeg; kind v4l2"),
        ("camera: {kind: v4l2, exposure_ms: 15600.0}", "is it in us? then write 15.6"),
        ("force: {axes_measured: []}", "axes_measured: []; allowed: one or more of Fx, Fy"),
        ("force: {axes_measured: [Fz, Fq]}", "allowed: Fx, Fy, Fz"),
    ],
)  # fmt: skip
def test_a_value_in_another_unit_is_refused(
    more: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = quick_bench(tmp_path, "tacpalm")
    path.write_text(f"extends: {BENCHES / 'tacpalm.yaml'}\n{more}\n")
    assert main(["collect", "--bench", str(path), "--out", str(tmp_path / "s.zarr")]) == 2
    assert re.search(re.escape(words), capsys.readouterr().err)


@pytest.mark.slow
def test_a_lab_bench_whose_devices_do_not_answer_exits_with_3_and_records_nothing(
    tmp_path: Path,
) -> None:
    bench, host = tmp_path / "lab.yaml", "127.0.0.239"
    bench.write_text(
        f"""
extends: {BENCHES / "tacpalm.yaml"}
mock: false
world: null
arm: {{host: {host}}}
force: {{host: {host}}}
camera: {{address: "http://{host}:8081/stream.mjpg"}}
gripper: {{kind: robotiq_2f, port: {tmp_path}/no-gripper}}
pedal: {{device: {tmp_path}/no-pedal}}
"""
    )
    with move_typed() as terminal:
        run = CollectionRun.collect(tmp_path / "s.zarr", "--bench", str(bench), stdin=terminal)
        assert run.wait() == 3, run.text
    assert run.lines[0].startswith("LAB BENCH")
    assert "the arm WILL move" in run.lines[0]
    # Every dead device is named, not only the first.
    found = run.text[run.text.index("5 devices:") :]
    named = [line.split()[0].rstrip(":") for line in found.splitlines()[1:6]]
    assert named == ["force", "pose", "camera", "gripper", "foot"]
    assert found.count(host) >= 3
    assert "nothing was recorded" in run.lines[-1]
    assert not run.session.exists()
