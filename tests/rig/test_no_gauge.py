"""Collecting without a force gauge: settings, guards that stand in, surface, wrong benches."""

import dataclasses
import functools
import io
import math
import multiprocessing
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.fake_clock import FakeClock
from benchmarks.faults.simulated_bench import SimulatedBench, Stages, Truth
from benchmarks.faults.wrong_benches import collected
from rig.acquire import no_gauge
from rig.acquire.calibration.onset import Onset, Way, onset_of, surface_of
from rig.acquire.calibration.store import (
    Calibration,
    FirstPressRecord,
    HomeCalibration,
    bench_hash,
    now_utc,
)
from rig.acquire.collector import CollectRequest
from rig.acquire.signal_level import SignalLevel, grey
from rig.acquire.stream_process import COUNTERS, _StreamLoop
from rig.bench.bench import Bench, BenchFile, bench_from
from rig.bench.expected import Skin
from rig.bench.guards import (
    SLOWEST,
    SURFACE_WIDTH,
    gentle,
    guard_limits,
    guards_of,
    left_out,
    left_out_text,
    slowed,
    without_gauge,
)
from rig.core.clock import SECOND_NS
from rig.core.config import read_yaml
from rig.core.errors import ConfigError, SafetyStop
from rig.core.guard import GuardLimits, MotionGuard
from rig.core.packaged import BENCHES, OTHERS
from rig.core.samples import FORCE_LATEST, POSE_LATEST, SIGNAL_LATEST
from rig.core.shared_memory import SharedLatest
from rig.core.stand_in_guards import CrashGuard, SignalGuard
from rig.devices.arm.emulated_arm import Wrist
from tactile.__main__ import main


def content_of(sensor: str, **more: Any) -> dict[str, Any]:
    return {**without_gauge(read_yaml(BENCHES / f"{sensor}.yaml", BENCHES), sensor), **more}


def bench_of(sensor: str, **more: Any) -> Bench:
    return bench_from(content_of(sensor, **more), "bench.yaml")


@pytest.mark.parametrize(
    "sensor",
    sorted(path.stem for path in BENCHES.glob("*.yaml") if path.stem not in OTHERS),
)
def test_every_packaged_mock_bench_may_be_used_without_its_gauge(sensor: str) -> None:
    bench = bench_of(sensor)
    assert [row.name for row in bench.of_kind("force")] == []
    assert len(guards_of(bench, Path("run"))) == 2
    depths = bench.dry_run(bench.trajectory).depths
    assert len(left_out(bench, bench.trajectory, depths)) <= len(depths) / 4


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"limits": {"sensor_rating_n": None}}, "limits.sensor_rating_n: missing; allowed with"),
        ({"stand_ins": None}, "stand_ins: missing; allowed with force: none"),
        ({"camera": None}, "force: none, but the bench has no camera or taxels"),
        ({"streams": {"g": {"kind": "netft"}}}, "force: none, but g has the role guard"),
        (
            {"streams": {"w": {"kind": "ur_wrench", "host": "h", "roles": ["label"]}}},
            "streams.w.roles: found label; allowed: guard",
        ),
        ({"force": "non"}, "force: found text 'non'; allowed: a mapping with kind netft or"),
        ({"skin": {"modulus_kpa": [7.0, 2.0]}}, "the lowest, then the highest"),
    ],
)
def test_a_bench_without_gauge_that_lacks_a_guard_is_refused(
    change: dict[str, Any], text: str
) -> None:
    content = content_of("gelsight")
    for key, value in change.items():
        merged = isinstance(value, dict) and isinstance(content.get(key), dict)
        content[key] = {**content[key], **value} if merged else value
    with pytest.raises(ConfigError, match=text):
        bench_from(content, "bench.yaml")


@pytest.mark.parametrize("no_gauge", [True, False])
def test_targets_whose_force_the_bench_cannot_record_are_left_out(no_gauge: bool) -> None:
    bench = bench_of("r6") if no_gauge else BenchFile.read(BENCHES / "r6.yaml").bench
    bench = dataclasses.replace(bench, indenter="wave")
    depths = bench.dry_run(bench.trajectory).depths
    out = left_out(bench, bench.trajectory, depths)
    limit = 9.0 if no_gauge else 0.85 * 17
    forces = [bench.expected.at(depth)[no_gauge] for depth in depths]
    assert out == {n: force for n, force in enumerate(forces) if force > limit}
    assert 0 < len(out) < len(depths)
    assert f"left out: targets {min(out) + 1} to 48; wave takes" in left_out_text(bench, out)
    stiff = dataclasses.replace(bench, skin=Skin("r6", (1e7, 1e7)))
    with pytest.raises(ConfigError, match=r"targets 1 to 48; wave takes .* allowed: .* N, so 0\."):
        CollectRequest.of(stiff, Path("session.zarr"))


def test_speeds_and_box_follow_the_rules() -> None:
    bench = slowed(bench_of("tacpalm"), 4.5e-3)
    assert bench.arm.speed == 2e-3
    assert bench.arm.travel_speed == 10e-3
    assert guard_limits(bench).box[0][2] == pytest.approx(-4.7e-3)


@given(st.floats(0.02, 0.5), st.sampled_from(["prism", "wave"]))
def test_a_press_does_not_reach_the_hard_limit_while_the_arm_reacts(
    reaction: float, indenter: str
) -> None:
    bench = dataclasses.replace(BenchFile.read(BENCHES / "r6.yaml").bench, indenter=indenter)
    expected, arm = bench.expected, gentle(bench, reaction).arm
    soft = np.interp(0.85 * 17, expected.most, expected.depths)
    assert arm.speed <= bench.arm.speed
    assert expected.at(soft + reaction * arm.speed)[1] <= 17 or arm.speed == SLOWEST


def signal_record(t_ns: int, fresh_ns: int, change: float, motion: float) -> Any:
    return np.array([(t_ns, fresh_ns, fresh_ns, change, motion)], SIGNAL_LATEST)


def wrench_record(t_ns: int, *force: float) -> Any:
    return np.array([(t_ns, 0, (*force, 0.0, 0.0, 0.0))], FORCE_LATEST)


SIGNAL = SignalGuard(largest=100.0, stale=0.2, unit="px", contact=40.0, way=0.25e-3)
CRASH = CrashGuard(force=9.0, stale=0.1)
S = SECOND_NS


@pytest.mark.parametrize(
    ("limits", "record", "mode", "kind", "text"),
    [
        (SIGNAL, signal_record(S, S, 0.0, 3.0), "guarded", None, ""),
        (SIGNAL, None, "guarded", "stale_force", "no signal"),
        (SIGNAL, signal_record(S - S // 4, S, 0, 0), "travel", "stale_force", "250 ms old"),
        (SIGNAL, signal_record(S, S - S // 4, 0, 0), "guarded", "stale_force", "is it frozen"),
        (SIGNAL, signal_record(S, S, 50.0, 3.0), "guarded", "force_soft", "contact with"),
        (SIGNAL, signal_record(S, S, 50.0, 101.0), "guarded", "force_hard", "allowed: 100 px"),
        (SIGNAL, signal_record(S, S, 0.0, math.nan), "guarded", "force_hard", "moved by nan"),
        (SIGNAL, signal_record(S, 0, 99.0, 999.0), "retreat", None, ""),
        (CRASH, wrench_record(S, 5.0, 5.0, 5.0), "guarded", None, ""),
        (CRASH, wrench_record(S, 6.0, 6.0, 6.0), "travel", "force_hard", "10.4 N since the last"),
        (CRASH, wrench_record(S, math.nan, 0.0, 0.0), "guarded", "force_hard", "nan N"),
        (CRASH, wrench_record(S - S // 4, 0.0, 0.0, 0.0), "guarded", "stale_force", "250 ms"),
        (CRASH, None, "guarded", "stale_force", "no wrench"),
        (CRASH, wrench_record(S, 99.0, 0.0, 0.0), "retreat", None, ""),
    ],
)
def test_guards_that_stand_in_stop_for_their_own_reason(
    limits: Any, record: Any, mode: Any, kind: str | None, text: str
) -> None:
    found = limits.check(S, record, mode)
    assert (None if found is None else found.kind) == kind
    assert text in ("" if found is None else found.reason)


@pytest.mark.parametrize("worst", range(3))
def test_guards_that_stand_in_see_every_record_since_their_last_look(worst: int) -> None:
    motions, forces = [3.0] * 3, [1.0] * 3
    motions[worst], forces[worst] = 101.0, 10.0
    signals = np.concatenate([signal_record(S, S, 0.0, motion) for motion in motions])
    wrenches = np.concatenate([wrench_record(S, force, 0.0, 0.0) for force in forces])
    for found in (SIGNAL.check(S, signals, "guarded"), CRASH.check(S, wrenches, "guarded")):
        assert found is not None
        assert found.kind == "force_hard"


def test_a_signal_that_shows_nothing_of_a_press_stops_it() -> None:
    frame, limits = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0), GuardLimits((1.0,) * 6, ((-1,) * 3, (1,) * 3))
    motion = MotionGuard(limits, frame)
    poses = np.zeros(1000, POSE_LATEST)
    poses["t_ns"], poses["safety_status"] = 2_000_000 * np.arange(1000), 1
    poses["value"][:, :3] = frame[:3]
    poses["value"][:, 2] += 1e-3 - 4e-6 * np.arange(1000)  # 2 mm/s down from 1 mm
    assert motion.check(int(poses["t_ns"][-1]), poses, "guarded") is None
    late = int(poses["t_ns"][-1])
    assert motion.travelled(0) == pytest.approx(2.894e-3, abs=3e-6)
    assert motion.travelled(late - S // 10) == pytest.approx(0.196e-3, abs=5e-6)
    for since_ns, kind in ((late - S // 10, None), (late - S // 6, "stale_force")):
        found = SIGNAL.check(late, signal_record(late, since_ns, 0, 0), "guarded", motion.travelled)
        assert (None if found is None else found.kind) == kind
    for mode in ("retreat", "guarded"):
        motion.check(late + 1, poses[-1:], mode)
    assert motion.travelled(0) == 0.0


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_fresh_noise_on_one_picture_is_no_motion(noise: float) -> None:
    rng, level = np.random.default_rng(1), SignalLevel(is_image=True)

    def shown(amount: float, noise: float) -> Any:
        image = pressed_pattern(amount) + rng.normal(0, noise, (480, 640, 1))
        return {"value": np.clip(image, 0, 255).astype(np.uint8)}

    for _ in range(16):
        level.add(shown(0.0, 1.0))
    level.zero()
    assert any(level.add(shown(amount, 1.0)).moved for amount in (0.5, 1.0, 1.5))
    assert not any([level.add(shown(1.5, noise)).moved for _ in range(20)][2:])
    assert any(level.add(shown(amount, 1.0)).moved for amount in (2.0, 2.5, 3.0))


def test_the_level_shows_contact_and_repeated_readings() -> None:
    rng = np.random.default_rng(0)
    level = SignalLevel(is_image=False)

    def counts(pressed: float) -> np.ndarray:
        found = rng.normal(1000.0, 2.0, (16, 3))
        found[5, 2] -= pressed
        return found.round()

    for _ in range(16):
        assert level.of(counts(0.0).astype(np.float32)).change == 0.0
    level.zero()
    rest = [level.of(counts(0.0).astype(np.float32)) for _ in range(50)]
    assert max(each.change for each in rest) < no_gauge.CONTACT / 2
    assert all(each.fresh for each in rest)
    pressed = counts(500.0).astype(np.float32)
    touched, again = level.of(pressed), level.of(pressed)
    assert touched.change > no_gauge.CONTACT
    assert touched.motion == pytest.approx(500.0, abs=10.0)
    assert not again.fresh


@functools.cache
def pressed_pattern(amount: float) -> np.ndarray:
    """Return a picture (480, 640, 3) of dots 70 px apart, pushed outwards by up to some px."""
    v, u = np.mgrid[:480, :640].astype(np.float64)
    x, y = u.copy(), v.copy()
    for _ in range(8):
        far = np.hypot(x - 320, y - 240) + 1e-6
        push = amount / 110 * np.exp(0.5 - (far / 110) ** 2 / 2)
        x, y = u - push * (x - 320), v - push * (y - 240)
    apart = np.hypot(x % 70 - 35, y % 70 - 35)
    light = 180 - 120 * np.clip((14 - apart) / 2 + 0.5, 0, 1)
    light += np.random.default_rng(round(1e3 * amount)).normal(0, 2, light.shape)
    return np.repeat(np.clip(light, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.slow
def test_the_motion_of_markers_is_read_beyond_half_a_pitch_and_back() -> None:
    level = SignalLevel(is_image=True)
    for _ in range(16):
        level.of(grey(pressed_pattern(0.0)))
    level.zero()
    amounts = [*np.linspace(0, 60, 21), *np.linspace(60, 0, 11)]
    motion = np.array([level.of(grey(pressed_pattern(amount))).motion for amount in amounts])
    ratio = motion / np.maximum(amounts, 1e-6)
    far = np.array(amounts) >= 12
    # Largest motions, of which 5 % of the edges may show more: nearly those of the ring.
    assert ((ratio > 0.6) & (ratio < 1.15))[far].all(), ratio
    assert motion[[0, -1]].max() < 4


def ways(surface: float, delay: float) -> tuple[Way, Way]:
    """Return a touch of a surface at a height [m] by a signal that is late by a length [m]."""
    rng = np.random.default_rng(1)
    z = np.linspace(0.6e-3, -0.2e-3, 50)

    def signal(true: np.ndarray) -> np.ndarray:
        return np.asarray(1e6 * np.maximum(surface - true, 0.0) + rng.normal(0.0, 1.0, 50))

    return Way(z, signal(z + delay)), Way(z[::-1], signal(z[::-1] - delay))


def test_the_delay_of_the_signal_cancels_between_in_and_out() -> None:
    found = onset_of(*ways(0.1e-3, 0.05e-3))
    assert found is not None
    onset, delay = found
    assert onset.z == pytest.approx(0.1e-3, abs=2e-6)
    assert delay == pytest.approx(0.05e-3, abs=2e-6)
    assert onset_of(*ways(-1.0e-3, 0.0)) is None


def touches(*onsets: list[tuple[float, float]]) -> Any:
    """Return a surface touched twice at each point: onsets and half their intervals [m]."""
    places = [(0.0, 0.0), (-3e-3, 4e-3), (-3e-3, -4e-3), (3e-3, -4e-3), (3e-3, 4e-3)]
    approaches = {
        point: [(Onset(z, (z - half, z + half), 1.0, 1.0, 0.0), 0.0) for z, half in each]
        for point, each in enumerate(onsets, 1)
    }
    return surface_of(approaches, dict(enumerate(places, 1)))


def test_a_point_at_which_the_signal_is_weak_counts_little() -> None:
    # As a sphere touched a simulated lattice of markers: two vague onsets under the first point.
    vague, sharp = [(91e-6, 37e-6), (84e-6, 30e-6)], [(8e-6, 10e-6), (4e-6, 13e-6)]
    surface = touches(vague, *[sharp] * 4).surface
    assert surface.interval[0] < 0.0 < surface.interval[1]
    assert surface.width < SURFACE_WIDTH


@pytest.mark.parametrize(
    ("heights", "shift", "text"),
    [
        ((0.0, 0.0, 0.0, 0.0, 0.0), 1e-3, None),
        ((0.0, 2e-4, 2e-4, -2e-4, -2e-4), 0.0, r"tilts by -3\.82 deg along x and \+0\.00 deg"),
        ((0.0, 0.0, 0.0, 0.0, 0.0), 4.9e-3, r"\+4\.90 mm from where .*is another indenter"),
    ],
)
def test_a_surface_that_is_uneven_or_elsewhere_is_refused(
    heights: tuple[float, ...], shift: float, text: str | None
) -> None:
    found = touches(*([(z + off, 1e-6) for off in (-1e-6, 1e-6)] for z in heights))
    assert found.surface.width < 30e-6
    with pytest.raises(SafetyStop, match=text) if text else nullcontext():
        no_gauge.check_surface(found, shift)


@pytest.mark.parametrize(
    ("date", "width", "text"),
    [
        (None, 0.0, "must be known for the indenter cylinder; measure it: tactile home"),
        ("2020-01-01T00:00:00Z", 1e-5, "h ago; allowed without a gauge: 24 h"),
        ("", 6e-5, r"known to 0\.060 mm; allowed without a gauge: 0\.050 mm"),
        ("", 4e-5, None),
    ],
)
def test_a_lab_bench_needs_a_fresh_and_narrow_surface(
    date: str | None, width: float, text: str | None
) -> None:
    bench = bench_of("gelsight")
    home = HomeCalibration(
        date or now_utc(), "m", False, "", (0.0,) * 6, (0.0,) * 6, 0.0, (0.0, width), ()
    )
    calibration = Calibration(None if date is None else home, file="c.yaml")
    with pytest.raises(ConfigError, match=text) if text else nullcontext():
        no_gauge.check_home(bench, calibration, "tactile home")


@pytest.mark.parametrize(
    ("hours", "of_this_file", "searched"),
    [(1.0, True, False), (25.0, True, True), (1.0, False, True)],
)
def test_a_mock_bench_searches_its_surface_unless_it_was_found_lately(
    hours: float,
    of_this_file: bool,
    searched: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    content = content_of("gelsight")
    bench = bench_from(content, "bench.yaml")
    frame, tcp = tuple(bench.contact_frame), tuple(bench.arm.tcp)
    date = str(np.datetime64(now_utc()[:-1]) - np.timedelta64(int(3600 * hours), "s")) + "Z"
    digest = bench_hash(content if of_this_file else {})
    home = HomeCalibration(date, "touch", True, digest, frame, tcp, 1e-4, (0.9e-4, 1.1e-4), (1e-4,))
    fresh = dataclasses.replace(home, date_utc=now_utc(), shift=2e-4)
    pressed = FirstPressRecord(now_utc(), True, tcp, 1e-3, (1.0,))
    asked: list[str] = []
    monkeypatch.setattr(no_gauge, "find_surface", lambda *_: asked.append("search") or fresh)
    monkeypatch.setattr(no_gauge, "press_in_steps", lambda *_: asked.append("press") or pressed)
    file, nothing = BenchFile(Path("bench.yaml"), content, bench), SimpleNamespace()

    def prepare() -> Calibration:
        calibration = Calibration(home=home)
        return no_gauge.prepare(file, tmp_path, calibration, 1e-3, nothing, print)  # type: ignore[arg-type]

    found = prepare()
    assert asked == (["search", "press"] if searched else ["press"])
    assert found.home == (fresh if searched else home)
    # The first press of a bench that was set up is remembered, as that of a lab's.
    asked.clear()
    prepare()
    assert asked == (["search", "press"] if searched else [])


def test_a_zero_is_for_the_guard_and_not_for_what_is_averaged(tmp_path: Path) -> None:
    """A second zero is measured like the first: the arm would else be stopped by its own bias."""
    bench = bench_of("tacpalm")
    name = "arm_wrench"
    latest = SharedLatest.create(tmp_path / f"{name}.latest", FORCE_LATEST)
    SharedLatest.create(tmp_path / f"{name}.counters", COUNTERS)
    ours, theirs = multiprocessing.Pipe()
    driver: Any = SimpleNamespace(dropped=0)
    clock = FakeClock(SECOND_NS)
    loop = _StreamLoop(name, bench, tmp_path, theirs, driver, clock)
    bias = np.array([3.0, -2.0, 4.0, 0.0, 0.0, 0.0])

    def measured() -> np.ndarray:
        loop._on_measure(1.0)
        for k in range(10):
            t_ns = clock.now_ns() + k * SECOND_NS // 10
            loop._take({"value": bias.copy(), "device_t": 0.0, "t_ns": t_ns})
        assert loop._measurement is not None
        return loop._measurement.result()["mean"]

    for _ in range(3):
        loop._on_zero(measured().tolist())
        assert ours.recv() == ("zeroed", None)
        np.testing.assert_array_equal(measured(), bias)
        record = latest.read()
        assert record is not None
        np.testing.assert_array_equal(record["value"], np.zeros(6))


@pytest.mark.parametrize(
    ("force", "words", "text"),
    [
        (
            "{kind: netft, host: 192.0.2.2}",
            ["--force", "none"],
            "is a lab bench; allowed: a mock bench; a lab bench states `force: none`",
        ),
        ("none", [], "no terminal to ask on"),
    ],
    ids=["no single word takes the gauge away", "none is left to a terminal"],
)
def test_a_lab_bench_is_used_without_gauge_by_its_file_and_at_a_terminal_only(
    force: str,
    words: list[str],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(
        f"extends: {BENCHES / 'gelsight.yaml'}\nmock: false\nworld: null\n"
        f"force: {force}\ncamera: {{kind: v4l2, address: /dev/video9, rate_hz: 30.0}}\n"
        "arm: {host: 192.0.2.1}\n"
    )
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    out = str(tmp_path / "s.zarr")
    assert main(["collect", "--bench", str(path), *words, "--out", out]) == 2
    assert text in capsys.readouterr().err


def test_the_emulated_wrist_has_bias_drift_and_a_wrong_gain() -> None:
    wrists = [Wrist(seed, payload_error=0.5) for seed in range(40)]
    gains = [wrist.gain for wrist in wrists]
    assert 0.7 <= min(gains) < 0.75
    assert 1.25 < max(gains) <= 1.3
    force = np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0])
    early = np.mean([wrists[0].reported(force, 0.0) for _ in range(200)], axis=0)
    rest = np.mean([wrists[0].reported(0 * force, 0.0) for _ in range(200)], axis=0)
    late = np.mean([wrists[0].reported(0 * force, 100.0) for _ in range(200)], axis=0)
    assert (early - rest)[2] == pytest.approx(-10 * gains[0], abs=0.05)
    assert abs(rest[2] + 0.5 * 9.81) <= Wrist.BIAS + 0.1
    assert np.abs(late - rest)[:3].max() > 0.1


@pytest.mark.slow
def test_a_wrong_bench_is_stopped_below_the_rating_and_named(tmp_path: Path) -> None:
    """A longer indenter and a sensor that freezes in the search, on the simulated clock."""
    bench = bench_of("uskin")
    truth = Truth(bench.world, longer=5e-3, wrist=Wrist(3))  # type: ignore[arg-type]
    clock = SimulatedBench(bench, truth, tmp_path)
    with pytest.raises(SafetyStop, match=r"the surface is \+4\.[89]\d mm from where"):
        no_gauge.find_surface(BenchFile(tmp_path, {}, bench), Stages(clock))
    assert 0 < clock.largest < 0.1 * 24.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 16, 21, 27, 30])
def test_wrong_benches_stay_below_the_rating(seed: int) -> None:
    assert collected(seed)["fraction"] < 1.0
