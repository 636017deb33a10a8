"""The surface is found by the onset of force, for any indenter, and sessions are shifted to it."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.collecting import tactile
from support.sessions import CONTACT_FRAME, T0, Columns, make_session

from benchmarks.faults.collection_run import quick_bench
from recorder import Session
from rig.acquire.calibration import home, store
from rig.acquire.calibration.onset import Onset, combine, find_onset, tilt
from rig.acquire.calibration.store import Calibration, HomeCalibration, LatencyCalibration
from rig.bench.bench import Bench, BenchFile
from rig.bench.guards import guard_limits
from rig.bench.worlds import WorldSpec
from rig.core.errors import ConfigError, SafetyStop
from rig.core.packaged import BENCHES
from rig.mock.world import LadderWorld
from tests.support.few import few
from trajectories import Touch, plan_from_json, plan_to_json


def _bench(sensor: str) -> Bench:
    return BenchFile.read(BENCHES / f"{sensor}.yaml").bench


def _approach(
    spec: WorldSpec, indenter: str, seed: int, *, surface: float = 0.0, noise: float = 0.01
) -> tuple[np.ndarray, np.ndarray]:
    """Return heights [m] and compression [N] of an approach at 1 mm/s to 0.3 N, one per ms."""
    heights, forces = _still_approach(spec, indenter)
    rng = np.random.default_rng(seed)
    return heights + surface, forces + rng.normal(0, noise, len(forces))


@functools.cache
def _still_approach(spec: WorldSpec, indenter: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise-free approach, which no seed changes."""
    world = LadderWorld(spec, indenter, (0.0,) * 6)
    heights, forces = [], []
    for number in range(4000):
        z = 1e-3 - 1e-6 * number
        forces.append(-world.step(number * 1_000_000, np.array([0, 0, z, 0, 0, 0]))["wrench"][2])
        heights.append(z)
        if forces[-1] > 0.3:
            break
    return np.array(heights), np.array(forces)


@pytest.mark.parametrize("indenter", ["cylinder", "sphere"])
@pytest.mark.parametrize("sensor", few(["tacpalm", "gelsight", "uskin"], 2))
def test_the_onset_is_found_whatever_presses_on_whatever_relaxes(
    sensor: str, indenter: str
) -> None:
    spec = _bench(sensor).world
    assert spec is not None
    inside, errors, onsets = 0, [], []
    for seed in range(4):
        onset = find_onset(*_approach(spec, indenter, seed, surface=0.2e-3, noise=0.003))
        assert onset is not None
        errors.append(onset.z - 0.2e-3)
        # The interval is that of one approach; `combine` adds 3 um for timing.
        low, high = combine([onset]).interval
        inside += low - 3e-6 <= 0.2e-3 <= high + 3e-6
        onsets.append(onset)
    assert np.abs(errors).max() < 25e-6
    assert inside >= 3
    low, high = combine(onsets).interval
    assert low <= 0.2e-3 <= high


def test_noise_alone_is_no_contact_and_values_that_are_no_numbers_are_refused() -> None:
    rng = np.random.default_rng(0)
    z = np.linspace(1e-3, -1e-3, 2000)
    assert find_onset(z, rng.normal(0, 0.01, 2000)) is None
    assert find_onset(z, np.zeros(2000)) is None
    assert find_onset(z, -np.maximum(-z, 0) * 300 + rng.normal(0, 0.01, 2000)) is None
    with pytest.raises(ValueError, match="finite"):
        find_onset(z, np.full(2000, np.nan))
    with pytest.raises(ValueError, match="at least 20"):
        find_onset(z[:10], z[:10])


def _onset(z: float, half: float) -> Onset:
    return Onset(z, (z - half, z + half), 1.0, 0.3, 0.01)


def test_approaches_that_disagree_make_a_wide_interval() -> None:
    agreeing = combine([_onset(z, 2e-6) for z in (0.0, 1e-6, -1e-6)])
    scattered = combine([_onset(z, 2e-6) for z in (0.0, 40e-6, -40e-6)])
    assert agreeing.width < 15e-6
    assert scattered.width > 150e-6
    assert scattered.interval[0] < scattered.z < scattered.interval[1]


def test_the_tilt_is_that_of_the_plane_through_the_points() -> None:
    places = np.array([[0, 0], [2e-3, 2e-3], [-2e-3, 2e-3], [-2e-3, -2e-3], [2e-3, -2e-3]])
    heights = 0.01 * places[:, 0] - 0.02 * places[:, 1] + 5e-5
    assert tilt(places, heights) == pytest.approx((0.01, -0.02, 5e-5))
    with pytest.raises(ValueError, match="no plane"):
        tilt(places[:2], heights[:2])


def test_touches_and_taps_survive_json_and_touch_nothing_beyond_their_travel() -> None:
    plan = Touch(travel=1e-3, points=(1, 3), repeats=2)
    assert plan_from_json(plan_to_json(plan)) == plan
    assert [target.point for target in plan.targets()] == [1, 1, 3, 3]
    assert min(move.end[2] for t in plan.targets() for move in plan.moves(t)) == -1e-3


def test_the_guard_of_an_approach_is_soft_and_its_hard_limit_stays() -> None:
    bench = _bench("tacpalm")
    limits = guard_limits(home.touching_bench(bench, 0.3))
    assert limits.soft_fraction * limits.force_rating[2] == pytest.approx(0.3)
    assert limits.hard_fraction == guard_limits(bench).hard_fraction
    for force in (0.0, -1.0, 10.0):
        with pytest.raises(ConfigError, match="--force"):
            home.touching_bench(bench, force)
    with pytest.raises(ConfigError, match="travel-mm"):
        home.plan_for(bench, force=0.3, travel=5.2e-3, repeats=3, points=(1,))


def _home(bench: Bench, **changes: object) -> HomeCalibration:
    measured = HomeCalibration(
        date_utc=store.now_utc(),
        method=home.METHOD,
        mock=bench.mock,
        bench_sha256="0" * 64,
        contact_frame=bench.contact_frame,
        tcp=bench.arm.tcp,
        shift=-0.3e-3,
        interval=(-0.31e-3, -0.29e-3),
        contacts=(-0.3e-3, -0.301e-3),
    )
    return dataclasses.replace(measured, **changes)  # type: ignore[arg-type]


def test_what_is_stored_is_read_again_and_shifts_the_frame(tmp_path: Path) -> None:
    bench = _bench("gelsight")
    path = store.store(tmp_path, "gelsight", home={"prism": _home(bench)})
    assert yaml.safe_load(path.read_text())["home"]["prism"]["shift_mm"] == pytest.approx(-0.3)
    found, warnings = store.load(tmp_path, bench, "prism")
    assert warnings == []
    assert found.home is not None
    assert found.home.shift == pytest.approx(-0.3e-3)
    moved = found.applied(bench).contact_frame
    assert np.subtract(moved, bench.contact_frame) == pytest.approx([0, 0, -0.3e-3, 0, 0, 0])
    assert Calibration.from_attrs(found.attrs()) == found
    # A second indenter is stored next to the first.
    store.store(tmp_path, "gelsight", home={"sphere": _home(bench, shift=1e-4)})
    assert store.load(tmp_path, bench, "prism")[0].home == found.home
    # Another indenter's surface is not used, with a warning; an old surface is used, with one too.
    other, warnings = store.load(tmp_path, bench, "moon")
    assert other.home is None
    assert "not for moon" in warnings[0]
    assert other.applied(bench) is bench
    store.store(tmp_path, "gelsight", home={"prism": _home(bench, date_utc="2020-01-01T00:00:00Z")})
    old, warnings = store.load(tmp_path, bench, "prism")
    assert old.home is not None
    assert "days old" in warnings[0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"contact_frame": (0.0,) * 6}, "another contact_frame"),
        ({"tcp": (0.0, 0.0, 0.2, 0.0, 0.0, 0.0)}, "another tcp"),
        ({"mock": False}, "measured on a lab bench"),
        ({"date_utc": "yesterday"}, "ISO 8601"),
    ],
)
def test_a_foreign_calibration_is_refused(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    bench = _bench("gelsight")
    store.store(tmp_path, "gelsight", home={"prism": _home(bench, **changes)})
    with pytest.raises(ConfigError, match=words):
        store.load(tmp_path, bench, "prism")


def test_a_file_of_another_sensor_or_a_torn_one_is_refused(tmp_path: Path) -> None:
    bench = _bench("gelsight")
    path = tmp_path / "gelsight.yaml"
    for text, words in (
        ("sensor: tacpalm\n", "sensor: found 'tacpalm'"),
        ("sensor: gelsight\nhome: {prism: {shift_mm: 1.0}}\n", "missing"),
        ("sensor: [", "not YAML"),
        ("sensor: gelsight\nhmoe: {}\n", "unknown"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=words):
            store.load(tmp_path, bench, "prism")


def test_a_latency_becomes_the_attributes_of_its_stream(tmp_path: Path) -> None:
    bench = _bench("gelsight")
    measured = LatencyCalibration(
        date_utc=store.now_utc(),
        method="taps",
        mock=True,
        bench_sha256="0" * 64,
        stream="camera",
        device=store.device_name(bench, "camera"),
        latency=0.0467,
        interval=(0.046, 0.0474),
        exposure=1 / 60,
        gel_lead=0.002,
        ratio=9.0,
        taps=16,
    )
    store.store(tmp_path, "gelsight", latency=measured)
    found, _ = store.load(tmp_path, bench, "prism")
    attrs = found.stream_attrs("camera")
    assert attrs["latency"] == pytest.approx(0.0467)
    assert attrs["latency_calibration"]["interval_s"] == pytest.approx([0.046, 0.0474])
    assert found.stream_attrs("force") == {}
    foreign = dataclasses.replace(measured, device="v4l2 /dev/video7")
    store.store(tmp_path, "gelsight", latency=foreign)
    with pytest.raises(ConfigError, match="another camera"):
        store.load(tmp_path, bench, "prism")


def _wrong_bench(folder: Path, height: float) -> list[str]:
    """Return the options of a bench whose surface is at a height [mm], and of its folder."""
    frame = f"world_frame: {{position_mm: [-120.0, -430.0, {height}]}}"
    bench = quick_bench(folder, "gelsight", more=frame)
    return ["--bench", str(bench), "--calibrations", str(folder)]


@pytest.mark.serial
@pytest.mark.slow
def test_home_finds_a_surface_that_the_bench_file_has_wrong_and_collect_goes_there(
    tmp_path: Path,
) -> None:
    kept = _wrong_bench(tmp_path, 159.7)
    ran = tactile("home", *kept, "--out", tmp_path / "h.zarr")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    stored = yaml.safe_load((tmp_path / "gelsight.yaml").read_text())["home"]["cylinder"]
    low, high = stored["interval_mm"]
    assert low <= -0.3 <= high
    assert high - low < 0.05
    assert "difference" in ran.stdout

    ran = tactile("collect", *kept, "--targets", "1", "--out", tmp_path / "s.zarr")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert any(line.startswith("home ") for line in ran.stdout.splitlines()[:4])
    session = Session(tmp_path / "s.zarr")
    assert session.attrs["calibration"]["home"]["shift"] == pytest.approx(-0.3e-3, abs=2e-5)
    assert session.attrs["contact_frame"][2] == pytest.approx(0.1597, abs=2e-5)
    lowest = np.asarray(session.streams["pose"].array("value"))[:, 2].min()
    assert lowest == pytest.approx(0.1597 - 0.3e-3, abs=5e-5)


@pytest.mark.serial
@pytest.mark.slow
def test_home_refuses_when_there_is_nothing_to_touch(tmp_path: Path) -> None:
    ran = tactile(
        *("home", *_wrong_bench(tmp_path, 155.0), "--repeats", "1", "--travel-mm", "0.5"),
        *("--out", tmp_path / "h.zarr"),
    )
    assert ran.returncode == 4, ran.stdout + ran.stderr
    assert "no contact at point 1 down to -0.50 mm" in ran.stdout
    assert not (tmp_path / "gelsight.yaml").exists()


def test_too_wide_an_interval_is_refused_with_its_width(tmp_path: Path) -> None:
    session = _touched(tmp_path, noise=0.05)
    plan = Touch(travel=1e-3, repeats=1)
    with pytest.raises(SafetyStop, match=r"mm wide; allowed: 0\.002 mm"):
        home.evaluate(session, plan, width_max=2e-6)
    assert abs(home.evaluate(session, plan, width_max=1e-3).surface.z) < 0.1e-3


def _touched(folder: Path, *, noise: float) -> Session:
    """Return a session of one approach to the TacPalm's World, without a bench."""
    spec = _bench("tacpalm").world
    assert spec is not None
    heights, forces = _approach(spec, "cylinder", 0, noise=noise)
    numbers = np.arange(len(heights))
    t_ns = T0 + (numbers + 1) * 1_000_000

    def approach(name: str, columns: Columns) -> Columns:
        if name == "segments":
            ends = {"start_ns": [T0 + 1], "end_ns": [t_ns[-1] + 1]}
            return {"target": [0], "phase": [0], "outcome": [1], "run": [0], **ends}
        value = np.zeros((len(numbers), 6))
        value[:, 2] = -forces if name == "force" else heights + CONTACT_FRAME[2]
        if name == "force":
            return {"t_ns": t_ns, "value": value, "seq": numbers, "status": 0 * numbers}
        value[:, :2] = CONTACT_FRAME[:2]
        ones = np.ones(len(numbers))
        return {"t_ns": t_ns, "value": value, "device_t": 1e-9 * t_ns, "speed_scaling": ones}

    return Session(make_session(folder / "touch.zarr", names=("force", "pose"), change=approach))
