"""Preflight rejections: slow device, tip in the sensor, noisy gauge, existing contact."""

import dataclasses
import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rig.acquire import streams as preflight
from rig.bench.bench import Bench, BenchFile, find_bench
from rig.core.errors import ConfigError, DeviceLost, SafetyStop
from rig.core.geometry import compose
from rig.core.packaged import BENCHES
from rig.core.samples import POSE_LATEST

BENCH: Bench = BenchFile.read(find_bench("tacpalm", BENCHES)).bench
RATES = {"force": 1000.0, "pose": 500.0, "camera": 30.0}


class FakeStreams:
    """Streams with measurements specified by the test."""

    def __init__(
        self, place: Any = (0.0, 0.0, 0.03), bench: Bench = BENCH, **measured: Any
    ) -> None:
        self.bench = bench
        self._measured = measured
        record = np.zeros(1, POSE_LATEST)[0]
        if place is not None:
            record["value"] = compose(BENCH.contact_frame, (*place, *BENCH.tool_rotation))
        self._pose = SimpleNamespace(latest=lambda: None if place is None else record)

    def __getitem__(self, name: str) -> SimpleNamespace:
        return self._pose

    def wait_opened(self) -> dict[str, Any]:
        return {name: {} for name in RATES}

    def measure(self, seconds: float, *names: str) -> dict[str, Any]:
        return {name: self._measured[name] for name in names or self._measured}


def rates(**changed: float) -> Any:
    found = {
        name: {"rate_hz": rate, "longest_gap": 2 / rate} for name, rate in (RATES | changed).items()
    }
    return FakeStreams(**found)


def test_expected_rates_pass_one_that_is_off_is_warned_of_and_half_of_it_is_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        assert preflight.check_devices(rates())[1] == RATES
        assert caplog.text == ""
        preflight.check_devices(rates(camera=24.0))
    assert "camera is -20 %" in caplog.text
    with pytest.raises(DeviceLost, match=r"camera: 14\.0 Hz measured; expected 30 Hz"):
        preflight.check_devices(rates(camera=14.0))


def test_the_tip_is_found_in_the_contact_frame() -> None:
    streams: Any = FakeStreams(place=(1e-3, -2e-3, 5e-3))
    assert preflight.tip_position(streams) == pytest.approx([1e-3, -2e-3, 5e-3], abs=1e-12)
    preflight.check_clear(streams)
    nowhere: Any = FakeStreams(place=None)
    with pytest.raises(DeviceLost, match="pose"):
        preflight.tip_position(nowhere)


@pytest.mark.parametrize(
    ("place", "word"),
    [
        ((0, 0, 0), "surface"),
        ((0, 0, -1e-3), "surface"),
        ((0.011, 0, 0.03), "box"),
        ((0, -0.011, 0.03), "box"),
        ((0, 0, 0.061), "box"),
    ],
)
def test_a_start_in_the_sensor_or_outside_the_box_is_refused(place: Any, word: str) -> None:
    streams: Any = FakeStreams(place=place)
    with pytest.raises(SafetyStop, match=word):
        preflight.check_clear(streams)


def test_a_still_gauge_is_tared_and_a_restless_or_silent_one_refused() -> None:
    mean, still = np.arange(6.0), np.full(6, 0.01)
    good: Any = FakeStreams(force={"n": 500, "mean": mean, "std": still})
    assert (preflight.take_tares(good)["force"]["mean"] == mean).all()
    restless: Any = FakeStreams(force={"mean": mean, "std": np.array([0, 0.3, 0, 0, 0, 0])})
    with pytest.raises(DeviceLost, match=r"Fy spreads by 0\.300 N"):
        preflight.take_tares(restless)
    silent: Any = FakeStreams(force={"n": 0})
    with pytest.raises(DeviceLost, match="no sample"):
        preflight.take_tares(silent)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_contact_before_the_press_is_refused_on_every_axis(axis: int, sign: int) -> None:
    force = np.zeros(6)
    force[axis] = sign * 0.29
    preflight.check_no_contact(BENCH, BENCH.gauges[0], force, point=3)
    force[axis] = sign * 0.31
    with pytest.raises(SafetyStop, match=f"point 3: F{'xyz'[axis]} is"):
        preflight.check_no_contact(BENCH, BENCH.gauges[0], force, point=3)


def _measuring(*axes: Any) -> Bench:
    force = dataclasses.replace(BENCH.force, axes_measured=axes)
    return dataclasses.replace(BENCH, force=force)


@pytest.mark.parametrize("axis", range(3))
def test_nan_hides_no_contact(axis: int) -> None:
    """Of NaN and -10 N, `argmax` chooses NaN, which is larger than no limit."""
    force = np.zeros(6)
    force[axis], force[(axis + 1) % 3] = np.nan, -10.0
    with pytest.raises(DeviceLost, match=f"F{'xyz'[axis]} not a number above point 3"):
        preflight.check_no_contact(BENCH, BENCH.gauges[0], force, point=3)
    others: Any = [f"F{name}" for place, name in enumerate("xyz") if place != axis]
    bench = _measuring(*others)
    with pytest.raises(SafetyStop, match=r"is -10\.00 N before the press"):
        preflight.check_no_contact(bench, bench.gauges[0], force, point=3)


def test_an_axis_that_is_not_measured_needs_no_tare() -> None:
    mean, std = np.array([np.nan] * 2 + [0.5] + [np.nan] * 3), np.full(6, np.nan)
    std[2] = 0.01
    measured = {"n": 500, "mean": mean, "std": std}
    streams: Any = FakeStreams(force=measured)
    axis: Any = FakeStreams(bench=_measuring("Fz"), force=measured)
    assert preflight.take_tares(axis)["force"]["mean"][2] == 0.5
    with pytest.raises(DeviceLost, match=r"Fx, Fy, Tx, Ty, Tz not a number during the tare"):
        preflight.take_tares(streams)
    std[2] = 0.3
    with pytest.raises(DeviceLost, match=r"Fz spreads by 0\.300 N"):
        preflight.take_tares(axis)


@pytest.mark.parametrize("name", ["a\nb", "a\x1b[31m", "../tacpalm", "-a", ""])
def test_a_sensor_is_a_plain_word(name: str) -> None:
    with pytest.raises(ConfigError, match=r"--sensor: found .*; allowed: printable letters"):
        find_bench(name)
