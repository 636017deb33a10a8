"""One test suite for every streaming device: its driver against its emulator."""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import tty
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.drivers import collect

from rig.core.clock import SystemClock
from rig.core.driver import Driver, Inbox, Receiver
from rig.core.emulation import Emulator, SharedWorld
from rig.core.errors import DeviceLost
from rig.core.packaged import BENCHES
from rig.devices.camera.jpeg import frame_stamp
from rig.devices.camera.mjpeg_emulator import LoopSource, MjpegEmulator, MjpegEmulatorConfig
from rig.devices.camera.opencv import OpenCvDriver
from rig.devices.camera.settings import CameraConfig
from rig.devices.force.netft import NetFtDriver
from rig.devices.force.netft_emulator import NetFtEmulator, NetFtEmulatorConfig
from rig.devices.force.nidaq import NidaqDriver
from rig.devices.force.nidaq_emulator import NidaqEmulator, NidaqEmulatorConfig
from rig.devices.force.scale import ScaleDriver
from rig.devices.force.scale_emulator import ScaleEmulator, ScaleEmulatorConfig
from rig.devices.force.settings import NetFtConfig, NidaqConfig, ScaleConfig
from rig.devices.taxels.settings import XelaConfig
from rig.devices.taxels.xela import XelaDriver
from rig.devices.taxels.xela_emulator import XelaEmulator, XelaEmulatorConfig
from tests.support.few import few

CLOCK = SystemClock()
CALIBRATION = BENCHES / "mock-nano17.cal"
OPEN_TIMEOUT = 5.0


@pytest.fixture(name="images", scope="session")
def folder_of_images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    for k in range(3):
        image = np.full((480, 640, 3), 60 * k, np.uint8)
        cv2.imwrite(str(folder / f"image_{k}.jpg"), image)
    return folder


class Valve:
    """A valve between an emulator and its client: open or shut."""

    def __init__(self) -> None:
        self.shut = threading.Event()

    def passing(self, items: Iterable[Any]) -> tuple[Any, ...]:
        return () if self.shut.is_set() else tuple(items)


class ValvedNetFt(NetFtEmulator):
    valve: Valve

    def packets(self, packet: bytes) -> Iterable[bytes]:
        return self.valve.passing(super().packets(packet))


class ValvedNidaq(NidaqEmulator):
    valve: Valve

    def samples(self, volts: np.ndarray) -> np.ndarray:
        return volts[:0] if self.valve.shut.is_set() else super().samples(volts)


class ValvedScale(ScaleEmulator):
    valve: Valve

    def lines(self, content: bytes) -> Iterable[bytes]:
        return self.valve.passing(super().lines(content))


class ValvedXela(XelaEmulator):
    valve: Valve

    def messages(self, message: str) -> Iterable[str]:
        return self.valve.passing(super().messages(message))


class ValvedMjpeg(MjpegEmulator):
    valve: Valve

    def parts(self, jpeg: bytes) -> Iterable[bytes]:
        return self.valve.passing(super().parts(jpeg))


def netft_emulator(host: str, valve: Valve, images: Path) -> Emulator:
    emulator = ValvedNetFt(NetFtEmulatorConfig(host=host), SharedWorld(None), CLOCK)
    emulator.valve = valve
    return emulator


def nidaq_emulator(host: str, valve: Valve, images: Path) -> Emulator:
    config = NidaqEmulatorConfig(NidaqConfig(str(CALIBRATION)), host=host)
    emulator = ValvedNidaq(config, SharedWorld(None), CLOCK)
    emulator.valve = valve
    return emulator


def link_of(host: str) -> Path:
    """Return the path of the link to a pty, since a serial port has no address."""
    return Path(tempfile.gettempdir()) / f"tactile-rig-test-{os.getpid()}-{host}"


def scale_emulator(host: str, valve: Valve, images: Path) -> Emulator:
    device = ScaleConfig("kern", str(link_of(host)), rate_hz=50.0)
    emulator = ValvedScale(ScaleEmulatorConfig(device=device), SharedWorld(None), CLOCK)
    emulator.valve = valve
    return emulator


def xela_emulator(host: str, valve: Valve, images: Path) -> Emulator:
    emulator = ValvedXela(XelaEmulatorConfig(host=host), SharedWorld(None), CLOCK)
    emulator.valve = valve
    return emulator


def mjpeg_emulator(host: str, valve: Valve, images: Path) -> Emulator:
    emulator = ValvedMjpeg(MjpegEmulatorConfig(host=host), LoopSource(images), None, CLOCK)
    emulator.valve = valve
    return emulator


@contextmanager
def mute_port(host: str, port: int) -> Iterator[None]:
    """A server that accepts connections and sends nothing."""
    with socket.create_server((host, port)):
        yield


@contextmanager
def mute_pty(host: str, port: int) -> Iterator[None]:
    """A serial port with nothing connected to its other end."""
    ours, theirs = os.openpty()
    link = link_of(host)
    try:
        tty.setraw(theirs)
        link.symlink_to(os.ttyname(theirs))
        yield
    finally:
        link.unlink()
        os.close(ours)
        os.close(theirs)


@dataclass(frozen=True)
class Kind:
    """One kind of device."""

    name: str
    driver: Callable[[str, float], Driver]
    emulator: Callable[[str, Valve, Path], Emulator]
    kind: str
    port: int
    columns: dict[str, tuple[type, tuple[int, ...] | None]]
    settings: str = "{}"
    mute: Callable[[str, int], AbstractContextManager[None]] = mute_port
    counted: bool = True
    """True if samples that the device did not send can be detected."""


KINDS = [
    Kind(
        "force",
        lambda host, silence: NetFtDriver(NetFtConfig(host, 8080, silence=silence), CLOCK),
        netft_emulator,
        "netft",
        8080,
        {"value": (np.float64, (6,)), "seq": (int, None), "status": (int, None)},
    ),
    Kind(
        "force-nidaq",
        lambda host, silence: NidaqDriver(
            NidaqConfig(str(CALIBRATION), grpc=f"{host}:31763", silence=silence), CLOCK
        ),
        nidaq_emulator,
        "nidaq",
        31763,
        {"value": (np.float64, (6,)), "seq": (int, None), "status": (int, None)},
        f'{{"device": {{"calibration": "{CALIBRATION}"}}}}',
    ),
    Kind(
        "force-scale",
        lambda host, silence: ScaleDriver(
            ScaleConfig("kern", str(link_of(host)), rate_hz=50.0, silence=silence), CLOCK
        ),
        scale_emulator,
        "scale",
        0,
        {
            **{"value": (np.float64, (6,)), "seq": (int, None), "status": (int, None)},
            **{"reading": (float, None), "settled": (bool, None)},
        },
        '{"device": {"protocol": "kern", "address": "LINK"}}',
        mute_pty,
        counted=False,
    ),
    Kind(
        "taxels",
        lambda host, silence: XelaDriver(XelaConfig(f"ws://{host}:5000", silence=silence), CLOCK),
        xela_emulator,
        "xela",
        5000,
        {"value": (np.int32, (16, 3)), "seq": (int, None), "device_t": (float, None)},
    ),
    Kind(
        "camera",
        lambda host, silence: OpenCvDriver(
            CameraConfig(f"http://{host}:8090/", silence=silence), CLOCK
        ),
        mjpeg_emulator,
        "opencv",
        8090,
        {"value": (bytes, None), "device_t": (float, None)},
        '{"source": "IMAGES"}',
    ),
]


@pytest.fixture(name="kind", params=KINDS, ids=lambda kind: kind.name)
def each_kind(request: pytest.FixtureRequest) -> Kind:
    kind: Kind = request.param
    return kind


@contextmanager
def running(kind: Kind, host: str, images: Path, silence: float = 20.0) -> Iterator[Any]:
    """Yield an open driver against an emulator in this process, and the valve between them."""
    valve = Valve()
    emulator = kind.emulator(host, valve, images)
    emulator.start()
    driver = kind.driver(host, silence)
    try:
        driver.open(OPEN_TIMEOUT)
        yield driver, valve
    finally:
        driver.close()
        emulator.close()


@contextmanager
def process_of(kind: Kind, host: str, images: Path) -> Iterator[subprocess.Popen[str]]:
    """Yield the emulator, started as by a user."""
    places = {"IMAGES": str(images), "LINK": str(link_of(host))}
    settings = kind.settings
    for word, place in places.items():
        settings = settings.replace(word, place)
    settings = json.dumps({**json.loads(settings), "host": host})
    process = subprocess.Popen(
        [sys.executable, "-m", "rig.mock.emulate", kind.kind, settings, "--until-stdin-closes"],
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
            link_of(host).unlink(missing_ok=True)


def read_until_lost(driver: Driver) -> str:
    for _ in range(100):
        try:
            driver.read(0.1)
        except DeviceLost as error:
            return str(error)
    raise AssertionError("the driver did not notice in 100 reads")


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


def test_an_error_nobody_expected_ends_the_stream_instead_of_silencing_it() -> None:
    def receive() -> None:
        raise KeyError("bug")

    inbox = Inbox(CLOCK, capacity=3)
    receiver = Receiver("device", receive, inbox)
    receiver.close()
    with pytest.raises(DeviceLost, match=r"device: receiving failed: KeyError\('bug'\)"):
        inbox.take(5.0)


def test_samples_have_the_declared_columns(kind: Kind, host: str, images: Path) -> None:
    with running(kind, host, images) as (driver, _):
        for sample in collect(driver, 5):
            assert set(sample) == {*kind.columns, "t_ns"}
            assert type(sample["t_ns"]) is int
            for name, (dtype, shape) in kind.columns.items():
                if shape is None:
                    assert isinstance(sample[name], dtype)
                else:
                    assert (sample[name].dtype, sample[name].shape) == (dtype, shape)


def test_times_strictly_increase_and_no_sample_is_repeated(
    kind: Kind, host: str, images: Path
) -> None:
    with running(kind, host, images) as (driver, _):
        samples = collect(driver, 15)
        times = [sample["t_ns"] for sample in samples]
        numbers = [
            frame_stamp(sample["value"])[0] if kind.name == "camera" else sample["seq"]
            for sample in samples
        ]
        assert all(a < b for a, b in itertools.pairwise(times))
        assert all(a < b for a, b in itertools.pairwise(numbers))


def test_description_is_json_and_names_the_device(kind: Kind, host: str, images: Path) -> None:
    with running(kind, host, images) as (driver, _):
        description = json.loads(json.dumps(driver.describe()))
        assert description["device"]
        assert host in description["address"]


def test_closing_is_safe_twice_and_it_opens_again(kind: Kind, host: str, images: Path) -> None:
    with running(kind, host, images) as (driver, _):
        driver.close()
        driver.close()
        with pytest.raises(DeviceLost, match="not open"):
            driver.read(0.1)
        driver.open(OPEN_TIMEOUT)
        assert collect(driver, 3)


def test_a_silent_device_reads_empty_and_then_goes_on_with_new_samples(
    kind: Kind, host: str, images: Path
) -> None:
    with running(kind, host, images) as (driver, valve):
        collect(driver, 3)
        valve.shut.set()
        while driver.read(0.3):
            pass
        reopened_ns = CLOCK.now_ns()
        valve.shut.clear()
        samples = collect(driver, 3)
        # An emulator sends what it was late for, but nothing of the 0.3 s of silence.
        assert samples[0]["t_ns"] > reopened_ns - 50_000_000
        if kind.name == "camera":
            assert frame_stamp(samples[-1]["value"])[1] > reopened_ns
        elif kind.counted:
            assert driver.dropped > 0


def test_what_waited_for_a_slow_consumer_keeps_the_time_it_arrived(
    kind: Kind, host: str, images: Path
) -> None:
    with running(kind, host, images) as (driver, _):
        collect(driver, 1)
        threading.Event().wait(0.5)
        before_read_ns = CLOCK.now_ns()
        samples = driver.read(1.0)
        assert len(samples) > 2
        assert samples[-3]["t_ns"] < before_read_ns


def test_a_killed_emulator_is_device_lost(kind: Kind, host: str, images: Path) -> None:
    with process_of(kind, host, images) as process:
        driver = kind.driver(host, 0.5)
        driver.open(OPEN_TIMEOUT)
        try:
            collect(driver, 3)
            process.kill()
            assert host in read_until_lost(driver)
        finally:
            driver.close()


def test_a_device_that_hangs_is_lost_and_gives_fresh_samples_when_it_is_back(
    kind: Kind, host: str, images: Path
) -> None:
    with process_of(kind, host, images) as process:
        driver = kind.driver(host, 0.5)
        driver.open(OPEN_TIMEOUT)
        try:
            collect(driver, 3)
            process.send_signal(signal.SIGSTOP)
            assert host in read_until_lost(driver)
            process.send_signal(signal.SIGCONT)
            resumed_ns = CLOCK.now_ns()
            driver.open(OPEN_TIMEOUT)
            samples = collect(driver, 3)
            assert samples[0]["t_ns"] > resumed_ns
            if kind.name == "camera":
                assert frame_stamp(samples[-1]["value"])[1] > resumed_ns
        finally:
            driver.close()


@pytest.mark.parametrize("how", few(["stdin", "SIGTERM"], 1))
def test_an_emulator_ends_when_told_or_left_alone(
    kind: Kind, host: str, images: Path, how: str
) -> None:
    with process_of(kind, host, images) as process:
        if how == "SIGTERM":
            process.terminate()
            _, errors = process.communicate(timeout=20)
        else:
            _, errors = process.communicate(timeout=20)  # closes stdin
        assert process.returncode == 0
        assert "ticks missed" in errors


def test_a_closed_port_is_device_lost(kind: Kind, host: str) -> None:
    driver = kind.driver(host, 1.0)
    with pytest.raises(DeviceLost, match=host):
        driver.open(1.0)
    driver.close()


def test_a_host_that_says_nothing_is_device_lost(kind: Kind, host: str) -> None:
    with kind.mute(host, kind.port):
        driver = kind.driver(host, 1.0)
        start_ns = CLOCK.now_ns()
        with pytest.raises(DeviceLost, match=host):
            driver.open(0.5)
        # Generous limit: it only must not hang.
        assert CLOCK.now_ns() - start_ns < 10_000_000_000
        driver.close()
