"""One test suite for every streaming device of the registry: its driver against its emulator.

Devices of installed packages are tested too: `pytest tests/rig/test_device_contract.py -k KIND`.
"""

import dataclasses
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints

import cv2
import numpy as np
import pytest
from support.drivers import collect

from rig.bench.bench import LOOPBACK, RUN_FOLDER
from rig.core.clock import SystemClock
from rig.core.config import READER
from rig.core.driver import Driver, Inbox, ReceivingDriver
from rig.core.emulation import Apply, Served
from rig.core.errors import DeviceLost
from rig.devices import registry
from rig.devices.camera.jpeg import frame_stamp
from rig.devices.registry import Device
from tests.support.few import few

CLOCK = SystemClock()
OPEN_TIMEOUT = 60.0


@pytest.fixture(name="images", scope="session")
def folder_of_images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    for k in range(3):
        image = np.full((480, 640, 3), 60 * k, np.uint8)
        cv2.imwrite(str(folder / f"image_{k}.jpg"), image)
    return folder


COLUMNS: dict[str, dict[str, type]] = {
    "force": {"value": np.ndarray, "seq": int, "status": int},
    "taxels": {"value": np.ndarray, "seq": int, "device_t": float},
    "camera": {"value": bytes, "device_t": float},
}


DEVICES = [each for each in map(registry.device, registry.kinds()) if each.example]


@pytest.fixture(name="device", params=DEVICES, ids=lambda each: each.kind)
def each_device(request: pytest.FixtureRequest) -> Device:
    return request.param


class Place:
    """One device at the loopback address of a test, with links of ptys in its own folder."""

    def __init__(self, device: Device, host: str, folder: Path, images: Path) -> None:
        self.device = device
        self.host = host
        folder = folder / host
        folder.mkdir()
        text = json.dumps(dict(device.example))
        text = text.replace(LOOPBACK, host).replace(RUN_FOLDER, str(folder))
        self.content: dict[str, Any] = json.loads(text)
        self.settings = READER.build(device.settings, self.content, device.kind)
        self.document = {"device": self.content, "host": host}
        if device.stream == "camera":
            self.document["source"] = str(images)

    def driver(self, silence: float) -> Driver:
        settings = dataclasses.replace(self.settings, silence=silence)
        return self.device.make_driver(settings, CLOCK)

    def served(self) -> Served:
        emulate = import_module(self.device.emulator).emulate
        kind = get_type_hints(emulate)["settings"]
        return emulate(READER.build(kind, self.document, self.device.kind), CLOCK)

    def number(self, sample: dict[str, Any]) -> int:
        """Return the number that the device gave a sample."""
        if self.device.stream != "camera":
            return int(sample["seq"])
        stamp = frame_stamp(sample["value"])
        assert stamp is not None
        return stamp[0]

    @contextmanager
    def mute(self) -> Iterator[None]:
        """Something at the device's address that accepts connections and sends nothing."""
        link = Path(str(self.content.get("address", "")))
        if link.is_absolute():
            ours, theirs = os.openpty()
            try:
                tty.setraw(theirs)
                link.symlink_to(os.ttyname(theirs))
                yield
            finally:
                link.unlink()
                os.close(ours)
                os.close(theirs)
            return
        port = re.search(rf"{self.host}:(\d+)|port\": (\d+)", json.dumps(self.content))
        assert port is not None, f"{self.device.kind}: its example names no port"
        with socket.create_server((self.host, int(port[1] or port[2]))):
            yield


@pytest.fixture(name="place")
def place_of_device(device: Device, host: str, tmp_path: Path, images: Path) -> Place:
    return Place(device, host, tmp_path, images)


@contextmanager
def running(place: Place, silence: float = 20.0) -> Iterator[tuple[Driver, Apply]]:
    """Yield an open driver against an emulator in this process, and the emulator's faults."""
    served = place.served()
    assert served.apply is not None
    served.emulator.start()
    driver = place.driver(silence)
    try:
        driver.open(OPEN_TIMEOUT)
        yield driver, served.apply
    finally:
        driver.close()
        served.emulator.close()


@contextmanager
def process_of(place: Place) -> Iterator[subprocess.Popen[str]]:
    """Yield the emulator, started as by a user."""
    settings = json.dumps(place.document)
    name = place.device.kind
    process = subprocess.Popen(
        [sys.executable, "-m", "rig.mock.emulate", name, settings, "--until-stdin-closes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready ")
            yield process
        finally:
            process.kill()


@contextmanager
def reading(place: Place) -> Iterator[tuple[Driver, subprocess.Popen[str]]]:
    """Yield a driver that has read samples of an emulator in a process of its own."""
    with process_of(place) as process:
        driver = place.driver(1.5)
        driver.open(OPEN_TIMEOUT)
        try:
            collect(driver, 3)
            yield driver, process
        finally:
            driver.close()


def read_until_lost(driver: Driver) -> str:
    for _ in range(1000):
        try:
            driver.read(0.1)
        except DeviceLost as error:
            return str(error)
    raise AssertionError("the driver did not notice in 1000 reads")


def test_what_nobody_takes_in_time_is_counted_and_equal_times_move_apart() -> None:
    inbox = Inbox(CLOCK, capacity=3)
    for number in range(5):
        inbox.put({"seq": number}, 1000)
    assert inbox.take(0.0) == [{"seq": k, "t_ns": 1000 + k} for k in range(3)]
    assert inbox.overflowed == 2
    inbox.put({"seq": 5}, 900)
    assert inbox.take(0.0) == [{"seq": 5, "t_ns": 1005}]


def test_the_end_of_a_stream_comes_after_all_that_was_received() -> None:
    inbox = Inbox(CLOCK, capacity=3)
    inbox.put({"seq": 1}, 1000)
    inbox.fail("unplugged")
    inbox.fail("and then closed")
    assert len(inbox.take(0.0)) == 1
    for _ in range(2):
        with pytest.raises(DeviceLost, match="unplugged"):
            inbox.take(0.0)


class Broken(ReceivingDriver):
    """Driver whose thread fails."""

    def _connect(self, timeout: float) -> None:
        pass

    def _receive(self) -> None:
        raise KeyError("bug")

    def _release(self) -> None:
        pass


def test_an_error_nobody_expected_ends_the_stream_instead_of_silencing_it() -> None:
    driver = Broken("device", CLOCK, capacity=3)
    driver.open(0.0)
    with pytest.raises(DeviceLost, match=r"device: receiving failed: KeyError\('bug'\)"):
        driver.read(5.0)
    driver.close()


def test_samples_have_the_declared_columns_and_the_description_names_the_device(
    place: Place,
) -> None:
    columns = COLUMNS[place.device.stream or ""]
    with running(place) as (driver, _):
        for sample in collect(driver, 5):
            assert set(sample) >= {*columns, "t_ns"}
            assert type(sample["t_ns"]) is int
            for name, kind in columns.items():
                assert isinstance(sample[name], kind)
            if place.device.stream == "force":
                assert (sample["value"].dtype, sample["value"].shape) == (np.float64, (6,))
            if place.device.stream == "taxels":
                height, width, axes = place.settings.shape
                assert sample["value"].dtype == np.int32
                assert sample["value"].shape == (height * width, axes)
        description = json.loads(json.dumps(driver.describe()))
        assert description["device"]
        assert place.host in description["address"]


def test_times_strictly_increase_and_no_sample_is_repeated(place: Place) -> None:
    with running(place) as (driver, _):
        for a, b in itertools.pairwise(collect(driver, 15)):
            assert a["t_ns"] < b["t_ns"]
            assert place.number(a) < place.number(b)


def test_closing_is_safe_twice_and_it_opens_again(place: Place) -> None:
    with running(place) as (driver, _):
        driver.close()
        driver.close()
        with pytest.raises(DeviceLost, match="not open"):
            driver.read(0.1)
        driver.open(OPEN_TIMEOUT)
        assert collect(driver, 3)


def test_a_silent_device_reads_empty_and_then_goes_on_with_new_samples(place: Place) -> None:
    with running(place) as (driver, inject):
        collect(driver, 3)
        inject("freeze")
        while driver.read(0.3):
            pass
        reopened_ns = CLOCK.now_ns()
        inject("clear")
        samples = collect(driver, 3)
        # An emulator sends what it was late for, but nothing of the 0.3 s of silence.
        assert samples[0]["t_ns"] > reopened_ns - 50_000_000
        if place.device.stream == "camera":
            assert frame_stamp(samples[-1]["value"])[1] > reopened_ns
        elif driver.describe().get("numbering") != "host":
            assert driver.dropped > 0


def test_what_waited_for_a_slow_consumer_keeps_the_time_it_arrived(place: Place) -> None:
    with running(place) as (driver, _):
        collect(driver, 1)
        samples: list[dict[str, Any]] = []
        while len(samples) < 3:
            threading.Event().wait(0.5)
            before_read_ns = CLOCK.now_ns()
            samples = driver.read(1.0)
        assert samples[-3]["t_ns"] < before_read_ns


def test_a_killed_emulator_is_device_lost(place: Place) -> None:
    with reading(place) as (driver, process):
        process.kill()
        assert place.host in read_until_lost(driver)


@pytest.mark.slow
def test_a_device_that_hangs_is_lost_and_gives_fresh_samples_when_it_is_back(place: Place) -> None:
    with reading(place) as (driver, process):
        process.send_signal(signal.SIGSTOP)
        assert place.host in read_until_lost(driver)
        process.send_signal(signal.SIGCONT)
        resumed_ns = CLOCK.now_ns()
        driver.open(OPEN_TIMEOUT)
        samples = collect(driver, 3)
        assert samples[0]["t_ns"] > resumed_ns
        if place.device.stream == "camera":
            assert frame_stamp(samples[-1]["value"])[1] > resumed_ns


@pytest.mark.parametrize("how", few(["stdin", "SIGTERM"], 1))
def test_an_emulator_ends_when_told_or_left_alone(place: Place, how: str) -> None:
    with process_of(place) as process:
        if how == "SIGTERM":
            process.terminate()
        _, errors = process.communicate(timeout=240)  # closes stdin
        assert process.returncode == 0
        assert "ticks missed" in errors


def test_a_closed_port_is_device_lost(place: Place) -> None:
    driver = place.driver(1.0)
    with pytest.raises(DeviceLost, match=place.host):
        driver.open(1.0)
    driver.close()


def test_a_host_that_says_nothing_is_device_lost(place: Place) -> None:
    with place.mute():
        driver = place.driver(1.0)
        # It must not hang.
        with pytest.raises(DeviceLost, match=place.host):
            driver.open(0.5)
        driver.close()
