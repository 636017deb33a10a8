"""The uSkin driver and emulator: message layouts, garbage, gaps, logs of raw counts."""

import itertools
import json
import math
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.drivers import FixedWorld, collect, opening, running

from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.taxels.settings import XelaConfig
from rig.devices.taxels.xela import XelaDriver
from rig.devices.taxels.xela_emulator import XelaEmulator, XelaEmulatorConfig, emit, load_log
from rig.devices.taxels.xela_wire import Scan, parse

CLOCK = SystemClock()

Fault = Callable[[int, str], Iterable[str]]


class FaultyXela(XelaEmulator):
    """Emulator that passes each message and its count to `fault`."""

    fault: Fault | None = None

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.faults.passed = self._messages

    def _messages(self, message: str) -> Iterable[str]:
        number = json.loads(message)["message"]
        return (message,) if self.fault is None else self.fault(number, message)


def emulated(
    host: str, fault: Fault | None = None, source: Any = None, **options: Any
) -> AbstractContextManager[FaultyXela]:
    config = XelaEmulatorConfig(XelaConfig(rate_hz=200.0), host=host, **options)
    counts = 48000.4 + np.arange(48).reshape(16, 3)
    emulator = FaultyXela(
        config, FixedWorld() if source is None else source, CLOCK, lambda state: counts
    )
    emulator.fault = fault
    return running(emulator)


def opened(host: str, timeout: float = 60.0, **options: Any) -> AbstractContextManager[XelaDriver]:
    config = XelaConfig(f"ws://{host}:5000", **({"silence": 20.0} | options))
    return opening(XelaDriver(config, CLOCK), timeout)


def scanned(text: str, sensor: str = "1", taxels: int = 16) -> Scan:
    scan = parse(text, sensor, taxels)
    assert scan is not None
    return scan


@given(
    number=st.integers(0, 2**40),
    seconds=st.floats(0, 2e9),
    counts=st.lists(st.integers(0, 0xFFFF), min_size=48, max_size=48),
    layout=st.sampled_from(["1.7", "1.8"]),
)
def test_parsing_a_scan_undoes_emitting_it(
    number: int, seconds: float, counts: list[int], layout: str
) -> None:
    scan = scanned(emit(number, seconds, counts, layout=layout, ups=60.0))
    assert (scan.message, scan.device_t) == (number, seconds)
    assert scan.counts.dtype == np.int32
    assert scan.counts.reshape(-1).tolist() == counts


def test_a_message_of_the_old_layout_is_understood_and_the_welcome_is_no_scan() -> None:
    assert parse('{"message": "Welcome"}', "1", 16) is None
    text = (
        '{"message":786,"time":1619157045.62,"sensors":1,"1":{"data":"FA00,FB00,7,0A,a,FFFF",'
        '"sensor":"1","taxels":2,"model":"XR1944","calibrated":null}}'
    )
    scan = scanned(text, "1", 2)
    assert scan.counts.tolist() == [[0xFA00, 0xFB00, 7], [10, 10, 0xFFFF]]
    assert scan.device_t == 1619157045.62


UPDATE = "update the XELA suite"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("garbage", "Expecting value"),
        ("[1, 2]", "not a JSON object"),
        ('{"message": null}', "expected a count"),
        ('{"message": 1, "2": {"data": "0,0,0"}}', r"the server has \['2'\]"),
        ('{"message": 1, "1": {"data": "0,0"}}', "2 values; expected 3 x 1"),
        ('{"message": 1, "1": {}}', "expected 3 x 1"),
        ('{"message": 1, "1": {"data": "0,0,xyz"}}', "xyz"),
        ('{"message": 1, "1": {"data": "0,0,10000"}}', "outside"),
        ('{"message": 1, "1": {"data": "0,0,-1"}}', "outside"),
        # Messages of the old suite.
        ('42["sensor_1",{"data":"..."}]', UPDATE),
        ('0{"sid":"abc","upgrades":["websocket"]}', UPDATE),
        ('{"time": 1, "sensor_1": [[1, 2, 3]]}', UPDATE),
        ('{"xyz": "0,0,0"}', UPDATE),
        # Python takes these for numbers, or nearly, and the server never sends them.
        *(
            (f'{{"message": 1, "1": {{"data": "{word},0,0"}}}}', "outside")
            for word in ("", " 7", "+7", "0x7", "1_0", "1.5", "1FFFF", "٣")
        ),
    ],
)
def test_anything_else_is_refused_with_a_reason(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        parse(text, "1", 1)


@pytest.mark.parametrize(("layout", "rate_hz"), [("1.7", None), ("1.8", 200.0)])
def test_the_worlds_taxels_arrive_rounded_with_its_description(
    host: str, layout: str, rate_hz: float | None
) -> None:
    with emulated(host, layout=layout), opened(host) as driver:
        sample = collect(driver, 1)[0]
        assert sample["value"].tolist() == (48000 + np.arange(48).reshape(16, 3)).tolist()
        properties = driver.describe()
        assert (properties["layout"], properties["rate_hz"]) == (layout, rate_hz)
        if layout == "1.8":
            assert (properties["model"], properties["vendor_calibration"]) == ("uSPa44", False)
            assert math.isfinite(sample["device_t"])


def test_lost_messages_are_counted_exactly(host: str) -> None:
    with (
        emulated(host, lambda number, text: () if number % 5 == 0 else (text,)),
        opened(host) as driver,
    ):
        numbers = [sample["seq"] for sample in collect(driver, 40)]
        lost = sum(b - a - 1 for a, b in itertools.pairwise(numbers))
        assert not [number for number in numbers if number % 5 == 0]
        assert 0 < lost <= driver.dropped


def test_a_server_that_counts_anew_goes_on_without_a_gap(host: str) -> None:
    def restarted(number: int, text: str) -> Iterable[str]:
        message = json.loads(text)
        message["message"] = number % 10
        return (json.dumps(message),)

    with emulated(host, restarted), opened(host) as driver:
        numbers = [sample["seq"] for sample in collect(driver, 40)]
        assert all(a < b for a, b in itertools.pairwise(numbers))


@pytest.mark.parametrize(
    ("option", "log", "text"),
    [
        ({"sensor": "2"}, np.zeros((1, 48)), "the server has"),
        ({}, np.zeros((1, 72)), "72 values; expected 3 x 16 taxels"),
    ],
)
def test_a_sensor_that_is_not_there_is_device_lost_with_what_is(
    host: str, option: dict[str, Any], log: Any, text: str
) -> None:
    with emulated(host, source=log), pytest.raises(DeviceLost, match=text), opened(host, **option):
        pass


def test_a_server_of_something_else_is_device_lost_and_an_address_that_is_none_is_refused(
    host: str,
) -> None:
    with emulated(host) as emulator:
        emulator.fault = lambda number, text: ()
        with pytest.raises(DeviceLost, match="no scan of sensor '1'"), opened(host, timeout=0.5):
            pass
    with pytest.raises(ConfigError, match="ws://host:port"):
        XelaDriver(XelaConfig("http://127.0.0.1:5000"), CLOCK).open(0.5)


def test_a_log_is_played_in_a_loop_and_another_shape_refused(host: str, tmp_path: Path) -> None:
    log = 30000.3 + np.arange(4 * 48).reshape(4, 48)
    np.save(tmp_path / "log.npy", log.astype(np.float32))
    with emulated(host, source=load_log(tmp_path / "log.npy")), opened(host) as driver:
        for sample in collect(driver, 12):
            row = np.rint(log[(sample["seq"] - 1) % 4]).reshape(16, 3)
            assert (sample["value"] == row).all()
    np.save(tmp_path / "log.npy", np.zeros((4, 47)))
    with pytest.raises(ValueError, match="expected"):
        load_log(tmp_path / "log.npy")


def test_noise_has_the_asked_spread(host: str) -> None:
    with emulated(host, noise=2.1, seed=1), opened(host) as driver:
        values = np.array([sample["value"] for sample in collect(driver, 60)])
        assert values.std(axis=0).mean() == pytest.approx(2.1, rel=0.2)


DATA = ",".join(f"{0x7A00 + 7 * k:X}" for k in range(48))
COUNTS = [0x7A00 + 7 * k for k in range(48)]


def frame(sensor: dict[str, Any] | None = None, **top: Any) -> str:
    part = {"data": DATA, "sensor": "1", "taxels": 16, "model": "XR1944", "calibrated": None}
    return json.dumps({"message": 786, "sensors": 1, **top, "1": part | (sensor or {})})


@pytest.mark.parametrize(
    "calibrated", [None, [0] * 48, [0.25] * 48, [0, 0.5] * 24, [], [-1e-3] * 48]
)
def test_calibrated_may_be_null_or_ints_or_floats_and_raw_counts_are_read_all_the_same(
    calibrated: Any,
) -> None:
    scan = scanned(frame({"calibrated": calibrated}, time=1.5))
    assert scan.counts.reshape(-1).tolist() == COUNTS
    assert scan.description["calibrated"] == calibrated


@pytest.mark.parametrize(
    ("sensor", "top", "device_t"),
    [
        ({}, {"time": 5.0}, 5.0),
        ({"time": 4.5}, {"time": 5.0}, 4.5),
        ({"time": 4.5}, {"time": 5.0, "sendtime": 5.1, "type": "routine"}, 4.5),
        ({"time": None}, {"time": 5.0}, 5.0),
        ({"time": "late"}, {"time": 5}, 5.0),
        ({}, {"sendtime": 5.1}, math.nan),
        ({"time": True}, {}, math.nan),
    ],
)
def test_device_time_is_when_the_sensor_was_scanned_never_when_it_was_sent(
    sensor: dict[str, Any], top: dict[str, Any], device_t: float
) -> None:
    assert scanned(frame(sensor, **top)).device_t == pytest.approx(device_t, nan_ok=True)


@pytest.mark.parametrize("word", ["7", "07", "007", "0007", "a", "0A", "fa00", "FA00", "0", "FFFF"])
def test_leading_zeros_may_be_there_or_not(word: str) -> None:
    scan = scanned(f'{{"message": 1, "1": {{"data": "{word},0,{word}"}}}}', "1", 1)
    assert scan.counts.tolist() == [[int(word, 16), 0, int(word, 16)]]


def test_of_several_sensors_in_one_message_the_bench_files_is_taken() -> None:
    other = {"data": ",".join(["1"] * 72), "sensor": "2", "taxels": 24, "model": "uSPa46"}
    text = json.dumps(json.loads(frame(time=5.0)) | {"sensors": 2, "2": other})
    one, two = scanned(text), scanned(text, "2", 24)
    assert one.counts.reshape(-1).tolist() == COUNTS
    assert two.counts.shape == (24, 3)
    assert (one.device_t, two.device_t) == (5.0, 5.0)


def test_a_patch_of_any_rows_columns_and_axes_is_read() -> None:
    assert XelaConfig(columns=6).shape == (4, 6, 3)
    alone = parse(frame({"data": ",".join(["7A00"] * 15), "taxels": 15}), "1", 15, 1)
    assert alone is not None
    assert alone.counts.shape == (15, 1)
    scan = scanned(frame({"data": ",".join(["7A00"] * 72), "taxels": 24}), "1", 24)
    assert scan.counts.shape == (24, 3)
    text = frame({"data": ",".join(["7A00"] * 72), "taxels": 24, "model": "XR1946"})
    with pytest.raises(ValueError, match="72 values; expected 3 x 16 taxels; it is a XR1946"):
        parse(text, "1", 16)
    with pytest.raises(ValueError, match="rows: 0; allowed: 1 to 1024"):
        XelaConfig(rows=0)


def test_values_that_all_jump_are_refused_and_ten_in_a_row_are_device_lost(host: str) -> None:
    def rescaled(number: int, text: str) -> Iterable[str]:
        message = json.loads(text)
        message["1"]["data"] = ",".join(w[:-1] for w in message["1"]["data"].split(","))
        return (json.dumps(message) if number % 20 == 5 else text,)

    with emulated(host) as emulator, opened(host) as driver:
        collect(driver, 1)
        emulator.fault = rescaled
        assert all(sample["value"].min() >= 48000 for sample in collect(driver, 60))
        assert driver.rejected["corrupt"] >= 2
        emulator.fault = lambda number, text: rescaled(5, text)
        with pytest.raises(DeviceLost, match="change its scale"):
            collect(driver, 10_000)


def test_late_scans_are_left_out_even_without_any_time(host: str) -> None:
    held: list[str] = []

    def timeless(number: int, text: str) -> Iterable[str]:
        message = json.loads(text)
        del message["time"], message["1"]["time"]
        text = json.dumps(message)
        if number % 5 == 0:
            held.append(text)
            return ()
        return (text, held.pop()) if held else (text,)

    with emulated(host, timeless), opened(host) as driver:
        numbers = [sample["seq"] for sample in collect(driver, 40)]
        assert all(a < b for a, b in itertools.pairwise(numbers))
        assert driver.rejected["late"] >= 5
