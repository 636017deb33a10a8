"""One word in the bench file selects the F/T sensor: configuration, guard, whole collections."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
from support.collecting import faults_of

from benchmarks.fake_clock import FakeClock
from benchmarks.faults.collection_run import CollectionRun, quick_bench
from recorder import Session
from rig.bench.bench import Bench, BenchFile
from rig.bench.guards import force_limit, guard_limits
from rig.cli.options import motion_lines
from rig.core.config import READER
from rig.core.errors import ConfigError
from rig.core.guard import ForceGuard
from rig.core.packaged import BENCHES
from rig.core.samples import FORCE_LATEST
from rig.devices.force.netft import NetFtDriver
from rig.devices.force.netft_wire import ERROR_MASK, SATURATION_MASK
from rig.devices.force.nidaq import NidaqDriver
from rig.devices.force.settings import (
    BEYOND_RATING,
    LOST_BEFORE,
    SATURATED,
    NetFtConfig,
    NidaqConfig,
)
from rig.mock.bench import MockBench
from rig.mock.emulate import EMULATORS
from rig.mock.world.truth import Truth

CALIBRATION = BENCHES / "mock-nano17.cal"
NIDAQ = f"{{kind: nidaq, grpc: 'loopback:31763', calibration: {CALIBRATION}}}"
FORCES = {"netft": "{rate_hz: 500.0}", "nidaq": NIDAQ}


def bench_with(folder: Path, force: str) -> Path:
    quick_bench(folder, "tacpalm")
    path = folder / "with.yaml"
    path.write_text(f"extends: bench.yaml\nforce: {force}\n")
    return path


def loaded(folder: Path, force: str) -> Bench:
    return BenchFile.read(bench_with(folder, force)).bench


def mock_bench(folder: Path, force: str) -> MockBench:
    return MockBench(BenchFile.read(bench_with(folder, force)), folder)


@pytest.mark.parametrize(
    ("kind", "config", "driver"),
    [("netft", NetFtConfig, NetFtDriver), ("nidaq", NidaqConfig, NidaqDriver)],
)
def test_one_word_picks_the_device(tmp_path: Path, kind: str, config: type, driver: type) -> None:
    bench = loaded(tmp_path, FORCES[kind])
    assert type(bench.force) is config
    assert type(bench.row("force").driver(FakeClock())) is driver
    assert bench.row("force").rate_hz == bench.force.rate_hz
    assert bench.force.address


@pytest.mark.parametrize("kind", FORCES)
def test_every_kind_has_an_emulator_for_the_mock_bench(tmp_path: Path, kind: str) -> None:
    bench = mock_bench(tmp_path, FORCES[kind])
    emulator, document = bench.documents()["force"]
    assert emulator == kind
    emulate = import_module(EMULATORS[emulator]).emulate
    settings = READER.build(get_type_hints(emulate)["settings"], document, "force")
    # The emulator is given the very settings that the driver is made with.
    assert settings.device == bench.bench.force
    assert settings.world == tmp_path / "world.state"
    assert (settings.host, settings.noise) == (bench.host, 0.01)


@pytest.mark.parametrize(
    ("force", "message"),
    [
        ("{kind: axia}", r"force\.kind: found 'axia'; allowed: .*nidaq"),
        (f"{NIDAQ[:-1]}, http_port: 80}}", r"force: unknown http_port"),
    ],
    ids=["a word that picks nothing", "a key of another kind"],
)
def test_what_no_kind_has_is_refused(tmp_path: Path, force: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        loaded(tmp_path, force)


def test_a_mock_bench_without_a_device_server_is_refused(tmp_path: Path) -> None:
    bench = mock_bench(tmp_path, f"{{kind: nidaq, calibration: {CALIBRATION}}}")
    with pytest.raises(ConfigError, match=r"force\.grpc: missing; allowed: loopback"):
        bench.documents()


def test_units_of_the_file_become_si(tmp_path: Path) -> None:
    tool = "tool: {displacement_mm: [0.0, 0.0, 20.0], rotation_deg: [0.0, 0.0, 90.0]}"
    force = loaded(tmp_path, f"{NIDAQ[:-1]}, {tool}, silence_ms: 250.0}}").force
    assert isinstance(force, NidaqConfig)
    assert force.tool.displacement == pytest.approx((0.0, 0.0, 0.02))
    assert force.tool.rotation == pytest.approx((0.0, 0.0, np.pi / 2))
    assert force.silence == 0.25


@pytest.mark.parametrize(
    ("limits", "rating"),
    [
        ("{sensor_rating_n: 10.0}", (10.0, 10.0, 10.0)),  # the sensor's, in any direction
        ("{sensor_rating_n: 14.0, force_rating_n: [12.0, 13.0, 20.0]}", (12.0, 12.0, 14.0)),
        ("{sensor_rating_n: 50.0, force_rating_n: [20.0, 20.0, 30.0]}", (12.0, 12.0, 17.0)),
        ("{sensor_rating_n: 50.0, force_rating_n: [2.0, 3.0, 4.0]}", (2.0, 3.0, 4.0)),
    ],
)
def test_the_lowest_rating_of_sensor_gauge_and_bench_bounds_every_press(
    tmp_path: Path, limits: str, rating: tuple[float, ...]
) -> None:
    """The gauge's calibration file rates it for 12, 12 and 17 N."""
    path = bench_with(tmp_path, NIDAQ)
    path.write_text(f"{path.read_text()}limits: {limits}\n")
    bench = BenchFile.read(path).bench
    (gauge,) = bench.gauges
    assert guard_limits(bench, gauge).force_rating[:3] == pytest.approx(rating)
    assert force_limit(bench) == pytest.approx(0.85 * rating[2])
    ends = ", ".join(f"{0.85 * each:.3g}" for each in rating)
    assert f"a press ends at {ends} N" in "\n".join(motion_lines(bench, 1e-3))
    # Without a gauge, a plan may reach half of the sensor's rating, and no more than the bench's.
    bare = BenchFile.read(BENCHES / "tacpalm.yaml").bench
    lowest = replace(bare.limits, sensor_rating=10.0)
    assert replace(bare, limits=lowest).force_rating[:3] == (10.0, 10.0, 10.0)


@pytest.mark.parametrize(
    ("kind", "status", "stops"),
    [
        ("netft", SATURATION_MASK, True),
        ("netft", ERROR_MASK, True),
        ("nidaq", SATURATED, True),
        ("nidaq", BEYOND_RATING | LOST_BEFORE, False),
    ],
)
def test_the_guard_stops_at_what_the_device_itself_does_not_trust(
    tmp_path: Path, kind: str, status: int, stops: bool
) -> None:
    bench = loaded(tmp_path, FORCES[kind])
    (gauge,) = bench.gauges
    guard = ForceGuard(guard_limits(bench, gauge))
    record = np.zeros(1, FORCE_LATEST)
    record["status"] = status
    violation = guard.check(0, record, "guarded")
    assert (violation is not None and violation.kind == "force_status") is stops


@pytest.mark.parametrize("rate_hz", [85.0, 200.0, 1000.0])
def test_the_guard_looks_ahead_at_the_rate_of_every_line(tmp_path: Path, rate_hz: float) -> None:
    bench = loaded(tmp_path, NIDAQ)
    limits = guard_limits(bench, *bench.gauges)
    guard = ForceGuard(limits)
    soft, speed = limits.soft_fraction * limits.force_rating[2], 100.0
    record = np.zeros(1, FORCE_LATEST)
    # 100 N/s: 20 ms before the soft limit is 2 N below it; samples are up to 1.2 N apart.
    for k in range(1000):
        t = k / rate_hz
        record["t_ns"], record["value"][:, 2] = round(1e9 * t), -speed * t
        violation = guard.check(int(record["t_ns"][0]), record, "guarded")
        if violation is not None:
            break
    assert violation is not None
    assert violation.kind == "force_soft"
    assert soft - 2.0 - speed / rate_hz < speed * t < soft


@pytest.mark.serial
@pytest.mark.slow
def test_two_targets_through_the_ni_card_have_the_true_wrench(tmp_path: Path) -> None:
    bench, path = bench_with(tmp_path, NIDAQ), tmp_path / "truth"
    words = ("--bench", str(bench), "--targets", "2", "--truth", str(path))
    run = CollectionRun.collect(tmp_path / "s.zarr", *words)
    assert run.wait(240) == 0, run.text
    assert faults_of(run.session) == []
    force, truth = Session(run.session).streams["force"], Truth(path)
    assert force.attrs["device"]["transducer"] == "FT00000"
    assert set(np.diff(np.asarray(force.array("seq")))) == {1}
    inside = force.t_ns < truth.records["t_ns"][-1]
    raw = np.asarray(force.array("value"))[inside] + np.asarray(force.attrs["bias"])
    error = raw - truth.wrench(force.t_ns[inside])
    assert raw[:, 2].min() < -0.3
    # 0.01 N of noise, and a few milliseconds at a few N/s; robust to a stalled machine.
    assert np.median(np.abs(error[:, :3])) < 0.02
