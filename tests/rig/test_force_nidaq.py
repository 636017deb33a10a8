"""The NI-DAQ driver, using the real client library, against the emulated card."""

from __future__ import annotations

import itertools
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.cal_files import emit_calibration
from support.drivers import FixedWorld, collect, opening, running

from rig.bench.bench import BenchStream
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES
from rig.devices.force import nidaq
from rig.devices.force.calibration import ToolTransform, read_calibration
from rig.devices.force.nidaq import NidaqDriver
from rig.devices.force.nidaq_emulator import NidaqEmulator, NidaqEmulatorConfig
from rig.devices.force.settings import BEYOND_RATING, LOST_BEFORE, SATURATED, NidaqConfig

CLOCK = SystemClock()
PORT = 31763
CALIBRATION = BENCHES / "mock-nano17.cal"
WRENCH = (1.0, -2.0, -3.5, 0.01, -0.02, 0.03)

Fault = Callable[[np.ndarray], np.ndarray]


class FaultyNidaq(NidaqEmulator):
    """Emulator that passes the converted samples to `fault`."""

    fault: Fault | None = None

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._passed = self.faults.passed
        self.faults.passed = self._samples

    def _samples(self, volts: np.ndarray) -> tuple[np.ndarray, ...]:
        return self._passed(volts if self.fault is None else self.fault(volts))


def emulated(
    host: str, wrench: tuple[float, ...] = WRENCH, **options: Any
) -> AbstractContextManager[FaultyNidaq]:
    config = NidaqEmulatorConfig(NidaqConfig(str(CALIBRATION)), host=host, **options)
    emulator = FaultyNidaq(config, FixedWorld(wrench=wrench), CLOCK)
    return running(emulator)


def opened(host: str, **options: Any) -> AbstractContextManager[NidaqDriver]:
    options = {"grpc": f"{host}:{PORT}", "silence": 20.0, **options}
    driver = NidaqDriver(NidaqConfig(str(CALIBRATION), **options), CLOCK)
    return opening(driver)


def rejected(host: str, **options: Any) -> str:
    with pytest.raises(ConfigError) as caught, opened(host, **options):
        pass
    return str(caught.value)


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


def test_a_saturated_gauge_is_flagged_and_the_wrench_is_wrong_then(host: str) -> None:
    overload = (0.0, 0.0, -100.0, 0.0, 0.0, 0.0)
    with emulated(host, overload), opened(host) as driver:
        sample = collect(driver, 1)[0]
        assert sample["status"] & SATURATED
        assert abs(sample["value"][2] + 100) > 1
        assert NidaqConfig.UNTRUSTED_MASK & sample["status"]


def test_beyond_the_rating_is_a_warning(host: str) -> None:
    with emulated(host, (0.0, 0.0, -20.0, 0.0, 0.0, 0.0)), opened(host) as driver:
        sample = collect(driver, 1)[0]
        assert sample["status"] == BEYOND_RATING
        assert not NidaqConfig.UNTRUSTED_MASK & sample["status"]


def test_the_gauges_own_offset_is_part_of_what_is_measured(host: str) -> None:
    offset = (0.1, -0.2, 0.3, 0.0, 0.05, -0.1)
    with emulated(host, offset=offset), opened(host) as driver:
        bias = read_calibration(CALIBRATION).wrench(offset)
        assert collect(driver, 1)[0]["value"] - bias == pytest.approx(WRENCH, abs=2e-3)


def test_a_stopped_sample_clock_leaves_a_gap_as_long_as_it_stood(host: str) -> None:
    stopped = threading.Event()
    with emulated(host) as emulator:
        emulator.fault = lambda volts: volts[:0] if stopped.is_set() else volts
        with opened(host) as driver:
            collect(driver, 50)
            stopped.set()
            while driver.read(0.3):
                pass
            stopped.clear()
            after = collect(driver, 20)
            first = next(sample for sample in after if sample["status"] & LOST_BEFORE)
            assert first is after[0]
            # Stopped for at least 0.3 s.
            assert driver.dropped >= 250
            assert [sample["seq"] for sample in after] == list(
                range(first["seq"], first["seq"] + len(after))
            )


def test_an_overrun_starts_anew_and_counts_what_was_lost(
    host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nidaq, "_BUFFER_MIN", 100)
    monkeypatch.setattr(nidaq, "_BUFFER_SECONDS", 0.1)
    burst = threading.Event()

    def flood(volts: np.ndarray) -> np.ndarray:
        if burst.is_set():
            burst.clear()
            return np.repeat(volts, 5000, axis=0)
        return volts

    with emulated(host) as emulator:
        emulator.fault = flood
        with opened(host) as driver:
            before = collect(driver, 50)[-1]["seq"]
            burst.set()
            samples = collect(driver, 20)
            while not any(sample["status"] & LOST_BEFORE for sample in samples):
                samples += collect(driver, 20)
            assert driver.overruns == 1
            numbers = [sample["seq"] for sample in samples]
            assert numbers[0] > before
            assert all(a < b for a, b in itertools.pairwise(numbers))
            times = [sample["t_ns"] for sample in samples]
            assert all(a < b for a, b in itertools.pairwise(times))


def test_silence_is_device_lost(host: str) -> None:
    stopped = threading.Event()
    with emulated(host) as emulator:
        emulator.fault = lambda volts: volts[:0] if stopped.is_set() else volts
        with opened(host, silence=0.3) as driver:
            stopped.set()
            with pytest.raises(DeviceLost, match=r"no sample for 0\.3 s"):
                collect(driver, 100_000)


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


def test_inputs_that_the_card_does_not_have_are_refused(host: str) -> None:
    with emulated(host):
        assert "Physical channel" in rejected(host, channels="ai12:17")
        assert "Physical channel" in rejected(host, channels="strain0")


def test_other_than_six_inputs_are_refused(host: str) -> None:
    with emulated(host):
        assert "channels: found 5; allowed: 6" in rejected(host, channels="ai0:4")


def test_a_rate_the_card_does_not_have_is_refused(host: str) -> None:
    with emulated(host, rate_max_hz=500.0):
        assert "not a supported value" in rejected(host)


class CoercingNidaq(NidaqEmulator):
    """A card that accepts any rate and range, and uses its own."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        service: Any = self._service
        configure, create = service.CfgSampClkTiming, service.CreateAIVoltageChan
        self.rate_hz: float | None = None
        self.high: float | None = None

        def clocked(request: Any, context: Any) -> Any:
            request.rate = self.rate_hz or request.rate
            return configure(request, context)

        def created(request: Any, context: Any) -> Any:
            request.max_val = self.high or request.max_val
            return create(request, context)

        service.CfgSampClkTiming, service.CreateAIVoltageChan = clocked, created


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("rate_hz", 800.0, "rate_hz: asked 1000 Hz, got 800 Hz"),
        ("high", 5.0, "asked -10 to 10 V, got -10 to 5 V"),
    ],
)
def test_a_setting_that_reads_back_otherwise_is_refused(
    host: str, setting: str, value: float, message: str
) -> None:
    config = NidaqEmulatorConfig(NidaqConfig(str(CALIBRATION)), host=host)
    emulator = CoercingNidaq(config, FixedWorld(wrench=WRENCH), CLOCK)
    setattr(emulator, setting, value)
    emulator.start()
    try:
        assert message in rejected(host)
    finally:
        emulator.close()


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
    driver = NidaqDriver(NidaqConfig(str(tmp_path / "FT1.cal"), grpc=f"{host}:{PORT}"), CLOCK)
    with pytest.raises(ConfigError, match=r"FT1\.cal"):
        driver.open(1.0)


def test_a_calibration_of_another_range_sets_the_card_to_it(host: str, tmp_path: Path) -> None:
    path = tmp_path / "FT1.cal"
    path.write_bytes(
        emit_calibration(replace(read_calibration(CALIBRATION), volts_range=(-5.0, 5.0)))
    )
    config = NidaqConfig(str(path), grpc=f"{host}:{PORT}", silence=20.0)
    with emulated(host, (0.0, 0.0, -60.0, 0.0, 0.0, 0.0)):
        driver = NidaqDriver(config, CLOCK)
        driver.open(60.0)
        try:
            assert driver.describe()["volts_range"] == [-5.0, 5.0]
            assert collect(driver, 1)[0]["status"] & SATURATED
        finally:
            driver.close()


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
