"""The NI-DAQ driver, using the real client library, against the emulated card."""

import itertools
import sys
import threading
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.cal_files import emit_calibration
from support.drivers import FixedWorld, collect, opening, running

from rig.bench.bench import BenchStream
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES
from rig.devices.force import nidaq
from rig.devices.force.calibration import ToolTransform, read_calibration
from rig.devices.force.nidaq import NidaqDriver, SampleTimeline
from rig.devices.force.nidaq_emulator import NidaqEmulator, NidaqEmulatorConfig
from rig.devices.force.settings import BEYOND_RATING, LOST_BEFORE, SATURATED, NidaqConfig

CLOCK = SystemClock()
PORT = 31763
CALIBRATION = BENCHES / "mock-nano17.cal"
WRENCH = (1.0, -2.0, -3.5, 0.01, -0.02, 0.03)


def emulated(
    host: str, wrench: tuple[float, ...] = WRENCH, **options: Any
) -> AbstractContextManager[NidaqEmulator]:
    config = NidaqEmulatorConfig(NidaqConfig(str(CALIBRATION)), host=host, **options)
    return running(NidaqEmulator(config, FixedWorld(wrench=wrench), CLOCK))


def opened(
    host: str, calibration: Path = CALIBRATION, **options: Any
) -> AbstractContextManager[NidaqDriver]:
    options = {"grpc": f"{host}:{PORT}", "silence": 20.0, **options}
    return opening(NidaqDriver(NidaqConfig(str(calibration), **options), CLOCK))


def test_the_wrench_comes_back_within_what_sixteen_bits_resolve(host: str) -> None:
    with emulated(host), opened(host) as driver:
        sample = collect(driver, 1)[0]
        assert sample["value"] == pytest.approx(WRENCH, abs=2e-3)
        assert sample["value"][3:] == pytest.approx(WRENCH[3:], abs=2e-5)
        assert sample["status"] == 0


def test_a_tool_frame_is_applied(host: str) -> None:
    tool = ToolTransform(displacement=(0.0, 0.0, 0.02))
    with emulated(host), opened(host, tool=tool) as driver:
        expected = (*WRENCH[:3], 0.01 - 0.02 * 2.0, -0.02 - 0.02 * 1.0, 0.03)
        assert collect(driver, 1)[0]["value"] == pytest.approx(expected, abs=2e-3)


def test_samples_are_numbered_without_a_gap_and_spaced_by_the_sample_clock(host: str) -> None:
    with emulated(host), opened(host) as driver:
        samples = collect(driver, 500)
        numbers = [sample["seq"] for sample in samples]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        steps = np.diff([sample["t_ns"] for sample in samples])
        # No blocks: all except the few where a quicker answer corrected the envelope.
        assert np.mean(np.abs(steps - 1_000_000) <= 1) > 0.9
        assert driver.dropped == 0


def test_the_settings_are_read_back_and_described(host: str) -> None:
    with emulated(host), opened(host, rate_hz=500.0) as driver:
        description = driver.describe()
        assert description["rate_hz"] == 500.0
        assert description["volts_range"] == [-10.0, 10.0]
        assert description["inputs"] == "differential"
        assert description["transducer"] == "FT00000"
        np.testing.assert_allclose(description["matrix"], read_calibration(CALIBRATION).matrix)


@pytest.mark.parametrize(
    ("fz", "status", "trusted"), [(-100.0, SATURATED, False), (-20.0, BEYOND_RATING, True)]
)
def test_a_saturated_gauge_is_not_trusted_and_beyond_the_rating_is_a_warning(
    host: str, fz: float, status: int, trusted: bool
) -> None:
    with emulated(host, (0.0, 0.0, fz, 0.0, 0.0, 0.0)), opened(host) as driver:
        sample = collect(driver, 1)[0]
        assert sample["status"] & (SATURATED | status) == status
        assert bool(NidaqConfig.UNTRUSTED_MASK & sample["status"]) is not trusted
        assert bool(sample["value"][2] == pytest.approx(fz, abs=0.01)) is trusted


def test_the_gauges_own_offset_is_part_of_what_is_measured(host: str) -> None:
    offset = (0.1, -0.2, 0.3, 0.0, 0.05, -0.1)
    with emulated(host, offset=offset), opened(host) as driver:
        bias = read_calibration(CALIBRATION).wrench(offset)
        assert collect(driver, 1)[0]["value"] - bias == pytest.approx(WRENCH, abs=2e-3)


def test_a_stopped_sample_clock_leaves_a_gap_as_long_as_it_stood(host: str) -> None:
    with emulated(host) as emulator, opened(host) as driver:
        collect(driver, 50)
        passed = emulator.faults.passed
        emulator.faults.passed = lambda volts: ()
        while driver.read(0.3):
            pass
        emulator.faults.passed = passed
        after = collect(driver, 20)
        first = next(sample for sample in after if sample["status"] & LOST_BEFORE)
        assert first is after[0]
        # Stopped for at least 0.3 s.
        assert driver.dropped >= 250
        expected = range(first["seq"], first["seq"] + len(after))
        assert [sample["seq"] for sample in after] == list(expected)


def test_an_overrun_starts_anew_and_counts_what_was_lost(
    host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nidaq, "_BUFFER_MIN", 100)
    monkeypatch.setattr(nidaq, "_BUFFER_SECONDS", 0.1)
    burst = threading.Event()

    def flood(volts: np.ndarray) -> tuple[np.ndarray]:
        repeats = 5000 if burst.is_set() else 1
        burst.clear()
        return (np.repeat(volts, repeats, axis=0),)

    with emulated(host) as emulator:
        emulator.faults.passed = flood
        with opened(host) as driver:
            before = collect(driver, 50)[-1]["seq"]
            burst.set()
            samples = collect(driver, 20)
            while not any(sample["status"] & LOST_BEFORE for sample in samples):
                samples += collect(driver, 20)
            assert driver.overruns == 1
            assert samples[0]["seq"] > before
            for a, b in itertools.pairwise(samples):
                assert a["seq"] < b["seq"]
                assert a["t_ns"] < b["t_ns"]


def test_an_unplugged_card_is_device_lost_and_can_be_plugged_in_again(host: str) -> None:
    with emulated(host) as emulator:
        with opened(host) as driver:
            collect(driver, 5)
            emulator.faults.inject("unplug")
            with pytest.raises(DeviceLost, match=r"cannot be accessed.*cable"):
                collect(driver, 100_000)
        with pytest.raises(DeviceLost, match="cable"), opened(host):
            pass
        emulator.faults.inject("replug")
        with opened(host) as driver:
            assert collect(driver, 5)


def test_a_name_that_no_card_has_is_device_lost(host: str) -> None:
    with (
        emulated(host),
        pytest.raises(DeviceLost, match=r"Dev7.*NI MAX"),
        opened(host, device="Dev7"),
    ):
        pass


@pytest.mark.parametrize(
    ("card", "options", "message"),
    [
        ({}, {"channels": "ai12:17"}, "Physical channel"),
        ({}, {"channels": "strain0"}, "Physical channel"),
        ({}, {"channels": "ai0:4"}, "channels: found 5; allowed: 6"),
        ({"rate_max_hz": 500.0}, {}, "not a supported value"),
    ],
)
def test_what_the_card_does_not_have_is_refused(
    host: str, card: dict[str, Any], options: dict[str, Any], message: str
) -> None:
    with emulated(host, **card), pytest.raises(ConfigError, match=message), opened(host, **options):
        pass


@pytest.mark.parametrize(
    ("call", "field", "value", "message"),
    [
        ("CfgSampClkTiming", "rate", 800.0, "rate_hz: asked 1000 Hz, got 800 Hz"),
        ("CreateAIVoltageChan", "max_val", 5.0, "asked -10 to 10 V, got -10 to 5 V"),
    ],
)
def test_a_setting_that_reads_back_otherwise_is_refused(
    host: str, call: str, field: str, value: float, message: str
) -> None:
    config = NidaqEmulatorConfig(NidaqConfig(str(CALIBRATION)), host=host)
    emulator = NidaqEmulator(config, FixedWorld(wrench=WRENCH), CLOCK)
    service: Any = emulator._service
    served = getattr(service, call)

    def coerced(request: Any, context: Any) -> Any:
        setattr(request, field, value)
        return served(request, context)

    setattr(service, call, coerced)
    with running(emulator), pytest.raises(ConfigError, match=message), opened(host):
        pass


def test_without_the_library_the_extra_is_named(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "rig.devices.force.nidaq")
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    config = NidaqConfig(str(CALIBRATION), grpc=f"{host}:{PORT}")
    with pytest.raises(ConfigError) as caught:
        BenchStream("force", config).driver(CLOCK)
    assert str(caught.value) == (
        "force: nidaqmx is not installed; install the extra: pip install 'tactile-rig[nidaq]'"
    )


def test_without_the_driver_of_the_card_it_is_said_so() -> None:
    driver = NidaqDriver(NidaqConfig(str(CALIBRATION)), CLOCK)
    with pytest.raises((ConfigError, DeviceLost), match="Dev1/ai0:5"):
        driver.open(1.0)
    driver.close()


def test_a_calibration_that_is_not_there_is_refused_before_anything_is_opened(
    host: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=r"FT1\.cal"), opened(host, tmp_path / "FT1.cal"):
        pass


def test_a_calibration_of_another_range_sets_the_card_to_it(host: str, tmp_path: Path) -> None:
    path = tmp_path / "FT1.cal"
    path.write_bytes(
        emit_calibration(replace(read_calibration(CALIBRATION), volts_range=(-5.0, 5.0)))
    )
    with emulated(host, (0.0, 0.0, -60.0, 0.0, 0.0, 0.0)), opened(host, path) as driver:
        assert driver.describe()["volts_range"] == [-5.0, 5.0]
        assert collect(driver, 1)[0]["status"] & SATURATED


def test_software_timed_reading_works_against_the_emulator_as_in_public_code(host: str) -> None:
    """As many scripts do: the emulator also serves clients other than our driver."""
    import grpc
    import nidaqmx
    from nidaqmx.constants import TerminalConfiguration

    with emulated(host), grpc.insecure_channel(f"{host}:{PORT}") as channel:
        options = nidaqmx.GrpcSessionOptions(channel, "")
        with nidaqmx.Task(grpc_options=options) as task:
            task.ai_channels.add_ai_voltage_chan(
                "Dev1/ai0:5", terminal_config=TerminalConfiguration.DIFF, min_val=-10, max_val=10
            )
            volts = task.read()
    assert read_calibration(CALIBRATION).wrench(volts) == pytest.approx(WRENCH, abs=2e-3)


def test_noise_has_the_asked_spread(host: str) -> None:
    with emulated(host, noise=0.1, seed=3), opened(host) as driver:
        values = np.array([sample["value"] for sample in collect(driver, 400)])
        assert values[:, 2].std() == pytest.approx(0.1, rel=0.3)
        assert values[:, 5].std() == pytest.approx(0.0005, rel=0.3)


# Sample times, from the lower envelope of the times at which the host received them.

RATE = 1000.0
PERIOD = SECOND_NS // 1000


def polled(delays_ns: list[int], drift: float = 0.0) -> np.ndarray:
    """Return the times of all samples; the host receives the end of each block `delays_ns` late."""
    timeline, every = SampleTimeline(RATE), 10
    times = []
    for k, delay_ns in enumerate(delays_ns, start=1):
        newest = k * every - 1
        taken_ns = 5 * SECOND_NS + round(newest * PERIOD * (1 + drift))
        timeline.observe(newest, taken_ns + delay_ns)
        times.append(timeline.take(newest - every + 1, every))
    return np.concatenate(times)


def test_samples_of_one_block_lie_a_period_apart() -> None:
    times = polled([300_000] * 20)
    assert set(np.diff(times).tolist()) == {PERIOD}
    assert times[0] == 5 * SECOND_NS + 300_000


def test_one_late_answer_moves_nothing() -> None:
    delays = [200_000] * 50
    delays[20] = 80_000_000
    assert set(np.diff(polled(delays)).tolist()) == {PERIOD}


def test_the_quickest_answer_counts() -> None:
    times = polled([2_000_000, 100_000, 2_000_000, 2_000_000])
    ideal = 5 * SECOND_NS + np.arange(40) * PERIOD
    assert np.all(times[20:] - ideal[20:] == 100_000)


@given(delays=st.lists(st.integers(0, 50_000_000), min_size=1, max_size=60))
def test_times_strictly_increase_and_never_lie_ahead_of_the_answer(delays: list[int]) -> None:
    times = polled(delays)
    assert all(a < b for a, b in itertools.pairwise(times.tolist()))
    newest = 5 * SECOND_NS + (np.arange(1, len(delays) + 1) * 10 - 1) * PERIOD + np.array(delays)
    # Ahead only where a quicker answer came later, by a nanosecond each.
    assert np.all(times[9::10] <= np.maximum.accumulate(newest) + 600)


@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
def test_a_card_whose_clock_drifts_is_followed(drift: float) -> None:
    times = polled([100_000] * 3000, drift=drift)
    taken = 5 * SECOND_NS + np.round(np.arange(30_000) * PERIOD * (1 + drift))
    # 100 ppm over the seconds for which the smallest delay is valid.
    assert np.abs(times - taken - 100_000).max() < 500_000
