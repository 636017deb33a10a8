"""Benches with none, one and three streams of each kind: settings, emulators, guard, collection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.collecting import faults_of, tactile

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from recorder import Session, SessionWriter, recover
from recorder.convert import FORMATS, export
from recorder.spec import frame_columns
from rig.acquire.plan_runner import reference_columns
from rig.acquire.streams import take_tares
from rig.bench.bench import Bench, BenchFile, bench_from
from rig.core.config import read_yaml
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from rig.mock.bench import MockBench

# Slow streams, because twelve devices, their emulators and the tests share the machine.
THREE = """
rate_hz: 20.0
arm: {rate_hz: 100.0}
force: {rate_hz: 200.0}
camera: {rate_hz: 10.0}
taxels: {kind: xela, address: "ws://loopback:5000", rate_hz: 20.0}
preflight: {timeout: 20.0}
limits: {stale_force_ms: 2000.0, stale_pose_ms: 2000.0, duration_max_min: 60.0}
streams:
  side: {kind: mjpeg, address: "http://loopback:8082/", rate_hz: 10.0}
  room: {kind: mjpeg, address: "http://loopback:8083/", rate_hz: 5.0, roles: [], align: nearest}
  left: {kind: netft, host: loopback, http_port: 8090, udp_port: 49153, rate_hz: 200.0}
  right: {kind: netft, host: loopback, http_port: 8091, udp_port: 49154, rate_hz: 100.0,
          roles: [label]}
  skin_2: {kind: xela, address: "ws://loopback:5001", rate_hz: 20.0}
  skin_3: {kind: xela, address: "ws://loopback:5002", rate_hz: 20.0}
  flange: {kind: ur_pose, host: loopback, rate_hz: 50.0}
  elbow: {kind: ur_pose, host: loopback, rate_hz: 25.0}
world: {noise: {force_n: 0.01, grey: 1.0, counts: 2.1}}
"""
NONE = """
extends: three.yaml
force: null
camera: null
taxels: null
streams: null
"""
ONE = """
extends: three.yaml
streams: null
"""
NAMES = ("force", "pose", "camera", "taxels", "side", "room", "left", "right")
NAMES += ("skin_2", "skin_3", "flange", "elbow")


def written(folder: Path) -> Path:
    """Write the three benches and return that with three of each."""
    first = quick_bench(folder, "gelsight")
    (folder / "three.yaml").write_text(f"extends: {first.name}\n{THREE}")
    (folder / "none.yaml").write_text(NONE)
    (folder / "one.yaml").write_text(ONE)
    return folder / "three.yaml"


@pytest.fixture
def three(tmp_path: Path) -> BenchFile:
    return BenchFile.read(written(tmp_path))


def test_single_keys_and_named_streams_are_rows_alike(three: BenchFile) -> None:
    bench = three.bench
    assert tuple(row.name for row in bench.rows) == NAMES
    assert {len(bench.of_kind(kind)) for kind in ("camera", "force", "pose", "taxels")} == {3}
    assert [row.name for row in bench.gauges] == ["force", "left"]
    assert bench.signal is not None
    assert bench.signal.name == "camera"
    columns = frame_columns((row.name, row.traits) for row in bench.rows)
    assert columns["left"] == "left"
    assert columns["force"] == "wrench"


def test_null_removes_a_device_and_every_named_stream(tmp_path: Path) -> None:
    bench = BenchFile.read(written(tmp_path).with_name("none.yaml")).bench
    assert [row.name for row in bench.rows] == ["pose"]
    assert bench.signal is None
    (tmp_path / "two.yaml").write_text("extends: three.yaml\nstreams: {side: null, left: null}\n")
    bench = BenchFile.read(tmp_path / "two.yaml").bench
    assert "side" not in [row.name for row in bench.rows]
    assert [row.name for row in bench.gauges] == ["force"]


CAMERA = {"kind": "mjpeg", "address": "http://loopback:8085/", "rate_hz": 10.0}


@pytest.mark.parametrize(
    ("streams", "text"),
    [
        ({"camera": CAMERA}, "streams.camera: found twice"),
        ({"depth": CAMERA}, "streams: stream depth: is the name of a column of frames"),
        ({"a b": CAMERA}, "allowed as a name: a letter"),
        ({"x": {**CAMERA, "kind": "camerra"}}, "streams.x.kind: found 'camerra'; allowed: "),
        ({"x": {**CAMERA, "roles": ["guard"]}}, "streams.x.roles: found guard"),
        ({"x": {**CAMERA, "roles": ["boss"]}}, "streams.x.roles.0.: found text 'boss'; allowed"),
        ({"x": {**CAMERA, "align": "mean"}}, "streams: x: found align 'mean'; allowed for its"),
        (
            {"x": {**CAMERA, "stamp": "start"}},
            "streams.x: unknown stamp with kind mjpeg; kind v4l2 has",
        ),
        (
            {"x": {"kind": "v4l2", "exposure_ms": 500.0}},
            "streams.x: exposure_ms: 500; allowed: up to",
        ),
        ({"x": {"kind": "ur_pose", "host": "h", "rate_hz": 900.0}}, "rate_hz: 900.0; allowed"),
        (["x"], "streams: found the list .*; allowed: a mapping from names"),
    ],
)
def test_streams_that_cannot_be_are_refused_by_key(streams: Any, text: str) -> None:
    content = read_yaml(BENCHES / "gelsight.yaml", BENCHES)
    with pytest.raises(ConfigError, match=text):
        bench_from({**content, "streams": streams}, "bench.yaml")


@pytest.mark.parametrize(("stated", "stamp"), [(None, "start"), ("middle", "middle")])
def test_a_v4l2_camera_stores_its_exposure_and_the_moment_of_its_times(
    stated: str | None, stamp: str
) -> None:
    content = read_yaml(BENCHES / "gelsight.yaml", BENCHES)
    camera = {"kind": "v4l2", "address": "/dev/video0", "rate_hz": 30, "exposure_ms": 8.0}
    bench = bench_from({**content, "camera": {**camera, "stamp": stated}}, "bench.yaml")
    properties: dict[str, Any] = {"jpeg_bytes_kept": True, "height": 480, "width": 640}
    properties |= {"stamp": "start", "device_clock": "monotonic"}
    spec = bench.row("camera").spec(properties, 30.0)
    assert (spec.traits.stamp, spec.attrs["exposure"]) == (stamp, 0.008)
    assert bench.row("camera").spec(properties, 30.0, exposure=0.004).attrs["exposure"] == 0.004


@pytest.mark.parametrize("force", [None, {"kind": "netft", "roles": ["label"]}])
def test_a_lab_bench_without_a_gauge_that_guards_is_refused(force: Any) -> None:
    content = {**read_yaml(BENCHES / "gelsight.yaml", BENCHES), "force": force}
    lab = {**content, "mock": False, "world": None}
    with pytest.raises(ConfigError, match="force: missing; allowed on a lab bench: an F/T sensor"):
        bench_from(lab, "bench.yaml")
    assert not bench_from(content, "bench.yaml").gauges  # a mock bench may


def test_every_device_has_its_own_emulator_and_fault_port(three: BenchFile, tmp_path: Path) -> None:
    documents = MockBench(three, tmp_path).documents()
    devices = [*NAMES[:1], "arm", *NAMES[2:4], *(f"{name}.device" for name in NAMES[4:10])]
    assert set(documents) == {"world", *devices}  # the arm's controller serves all poses
    ports = [document["fault_port"] for name, (_, document) in documents.items() if name != "world"]
    assert len(set(ports)) == len(ports)
    assert documents["side.device"][1]["view"].endswith("world.json")


class Measured:
    """Streams whose means are their place among the bench's rows."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def measure(self, seconds: float, *names: str) -> dict[str, dict[str, Any]]:
        fixed = {"std": np.full(6, 0.01), "t_ns": 5}
        return {name: {"mean": np.full(6, 0.1 * NAMES.index(name)), **fixed} for name in names}

    def __getitem__(self, name: str) -> Measured:
        return self

    def latest(self) -> dict[str, int]:
        return {"row": 7}


def test_every_gauge_is_tared_and_has_its_own_reference(three: BenchFile, tmp_path: Path) -> None:
    bench, streams = three.bench, Measured(three.bench)
    tares = take_tares(streams)  # type: ignore[arg-type]
    assert {name: tare["mean"][0] for name, tare in tares.items()} == pytest.approx(
        {"force": 0.0, "left": 0.6, "right": 0.7}
    )
    found = streams.measure(1.0, "force", "left", "right")
    found |= {name: {"mean": np.ones((16, 3))} for name in ("taxels", "skin_2", "skin_3")}
    row = reference_columns(streams, found)  # type: ignore[arg-type]
    scalars = {key: value for key, value in row.items() if np.ndim(value) == 0}
    assert scalars == {"image": 7, "side": 7, "room": 7}
    specs = [each.empty_spec() for each in bench.rows]
    targets = {"point": np.zeros(1, np.int16)}
    path = tmp_path / "s.zarr"
    with SessionWriter.create(path, attrs={}, streams=specs, targets=targets) as session:
        session.reference.append(**row, point=1, run=0, t_ns=5)
    stored = Session(path).reference
    np.testing.assert_allclose(stored["left"][0], 0.6)
    np.testing.assert_allclose(stored["right_std"][0], 0.01)


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize(
    ("name", "wanted"), [("none", {"pose"}), ("one", set(NAMES[:4])), ("three", set(NAMES))]
)
@pytest.mark.timeout(900)
def test_collected_killed_recovered_resumed_replayed_checked_and_exported(
    name: str, wanted: set[str], tmp_path: Path
) -> None:
    bench = written(tmp_path).with_name(f"{name}.yaml")
    path = tmp_path / "s.zarr"
    run = CollectionRun.collect(path, "--targets", "2", "--bench", str(bench))
    run.until(lambda: run.session.exists() and run.segments() > 100, "a second phase", 400)
    run.kill_all()
    assert recover(path).status == "recovered"
    assert set(Session(path).streams) == wanted
    assert faults_of(path, stopped=True) == []
    # With the packaged bench of the sensor.
    run = CollectionRun.collect(path, "--resume", str(path))
    assert run.wait(240) == 2
    assert "was recorded with the streams" in run.text
    run = CollectionRun.collect(path, "--resume", str(path), "--bench", str(bench))
    assert run.wait(400) == 0, run.text
    session = Session(path)
    assert (session.status, len(session.runs)) == ("complete", 2)
    assert faults_of(path, stopped=True) == []
    frames = session.frames
    inside = frames["valid"][frames["run"] == 1]
    assert inside.mean() > 0.8, "a busy machine may delay single samples"
    assert {name for name, column in session.columns.items() if column in frames} == wanted
    assert set(session.window(int(frames["t_ns"][-5]), 3).streams) == wanted
    again = tactile("replay", "--session", path, "--out", tmp_path / "r.zarr", "--speed", "max")
    assert again.returncode == 0, again.stdout + again.stderr
    assert "equal:" in again.stdout
    for to in FORMATS:
        if to != "genforce" or session.of_kind("camera"):
            export(path, tmp_path / to, to)
            assert (tmp_path / to).exists()
