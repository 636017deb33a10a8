"""Line faults: messages sent in place of each original, on a fake clock, and the reactions of the
real drivers."""

import itertools
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from support.drivers import FixedWorld, collect, opening, running

from benchmarks.fake_clock import FakeClock
from rig.core import emulation
from rig.core.clock import SystemClock
from rig.core.emulation import FaultPort
from rig.core.errors import DeviceLost
from rig.core.fault_injection import FAULTS, FaultInjector, corrupted_bytes, corrupted_text
from rig.devices.arm.emulated_arm import POSTURE, flange_pose
from rig.devices.arm.emulated_controller import Controller
from rig.devices.arm.emulator import ArmEmulator
from rig.devices.arm.reader import RtdePoseDriver
from rig.devices.arm.settings import ArmConfig
from rig.devices.camera.camera import MjpegDriver
from rig.devices.camera.mjpeg_emulator import MjpegEmulator, MjpegEmulatorConfig, rendered
from rig.devices.camera.settings import MjpegConfig
from rig.devices.force.netft import NetFtDriver
from rig.devices.force.netft_emulator import NetFtEmulator, NetFtEmulatorConfig
from rig.devices.force.settings import NetFtConfig
from rig.devices.taxels.settings import XelaConfig
from rig.devices.taxels.xela import XelaDriver
from rig.devices.taxels.xela_emulator import XelaEmulator, XelaEmulatorConfig

CLOCK = SystemClock()


@pytest.fixture(name="clock")
def clock_of_its_own() -> FakeClock:
    return FakeClock(10**9)


def text_line(clock: FakeClock, **options: Any) -> FaultInjector[str]:
    return FaultInjector[str](clock, spoil=corrupted_text, **options)


def sent(line: FaultInjector[str], clock: FakeClock, count: int) -> list[str]:
    """Return the output for `count` messages, 0.1 s apart."""
    out: list[str] = []
    for number in range(1, count + 1):
        out += line.passed(f"m{number}")
        clock.advance(0.1)
    return out


@pytest.mark.parametrize(
    ("fault", "values", "count", "numbers", "touched", "on"),
    [
        ("clear", {}, 3, [1, 2, 3], 0, False),
        ("freeze", {"seconds": 0.25}, 5, [4, 5], 3, False),
        ("slow", {"fraction": 0.25}, 12, [4, 8, 12], 9, True),
        ("reorder", {"every": 3}, 7, [1, 2, 4, 3, 5, 7, 6], 2, True),
        ("reorder", {"every": 2, "seconds": 0.15}, 4, [1, 3, 2, 4], 1, False),
        ("duplicate", {"every": 2}, 4, [1, 2, 2, 3, 4, 4], 2, True),
    ],
    ids=[
        "nothing wrong changes nothing",
        "a frozen line is mute for its time and then goes on",
        "a slow line lets a part through",
        "every third message leaves after the next",
        "a message held back leaves even after the fault",
        "every other message leaves twice",
    ],
)
def test_messages_leave_as_the_fault_says(
    clock: FakeClock, fault: str, values: Any, count: int, numbers: Any, touched: int, on: bool
) -> None:
    line = text_line(clock)
    line.inject(fault, **values)
    assert sent(line, clock, count) == [f"m{number}" for number in numbers]
    assert (line.touched, line.on) == (touched, on)
    line.inject("clear")
    assert sent(line, clock, 2)[-2:] == ["m1", "m2"]


def test_garbage_is_as_long_as_what_it_replaces(clock: FakeClock) -> None:
    line = FaultInjector[bytes](clock, spoil=corrupted_bytes)
    line.inject("garbage", messages=3)
    message = bytes(range(36))
    out = [line.passed(message) for _ in range(5)]
    assert [len(messages) for messages in out] == [1] * 5
    assert [messages[0] == message for messages in out] == [False] * 3 + [True] * 2
    assert all(len(messages[0]) == 36 for messages in out)
    assert line.touched == 3


def test_units_are_the_devices_own_affair(clock: FakeClock) -> None:
    line = text_line(clock, mistake=str.upper)
    line.inject("wrong_units")
    assert line.wrong_units
    assert line.passed("m1") == ("M1",)
    line.inject("clear")
    assert line.passed("m1") == ("m1",)


def test_pulling_the_plug_is_told_and_so_is_its_end(clock: FakeClock) -> None:
    told: list[bool] = []
    line: FaultInjector[str] = text_line(clock, on_change=lambda: told.append(line.unplugged))
    line.inject("unplug", seconds=1.0)
    assert line.passed("m1") == ()
    clock.advance(1.0)
    assert line.passed("m2") == ("m2",)
    line.inject("unplug")
    line.inject("replug")
    assert told == [True, False, True, False]


def test_faults_add_up_and_are_listed(clock: FakeClock) -> None:
    line = text_line(clock)
    line.inject("duplicate", every=1)
    assert line.inject("garbage") == {"active": ["duplicate", "garbage"], "touched": 0}
    assert len(line.passed("abcdef")) == 2
    assert line.inject("clear")["active"] == []


@pytest.mark.parametrize(
    ("fault", "values", "complaint"),
    [
        ("melt", {}, "found 'melt'"),
        ("slow", {"speed": 1}, r"unknown \['speed'\]"),
        ("freeze", {"seconds": "soon"}, "soon"),
    ],
)
def test_what_no_line_can_do_is_refused(
    clock: FakeClock, fault: str, values: dict[str, Any], complaint: str
) -> None:
    line = text_line(clock)
    with pytest.raises(ValueError, match=complaint):
        line.inject(fault, **values)
    assert not line.on


def test_the_fault_port_takes_faults_and_survives_nonsense(host: str, clock: FakeClock) -> None:
    line = text_line(clock)
    port = FaultPort(host, 31001, line.inject)
    try:
        assert emulation.inject(host, 31001, "freeze", seconds=2.0)["active"] == ["freeze"]
        assert line.passed("m1") == ()
        with pytest.raises(ValueError, match="melt"):
            emulation.inject(host, 31001, "melt")
        with socket.create_connection((host, 31001), 5.0) as raw:
            raw.sendall(b'{"fault": \n[]\n{"fault": "clear"}\n')
            answers = raw.makefile("rb")
            assert [b'"ok": true' in answers.readline() for _ in range(3)] == [False, False, True]
        with socket.create_connection((host, 31001), 5.0) as flood:
            flood.sendall(b"x" * (1 << 18))
        assert emulation.inject(host, 31001, "state")["active"] == []
    finally:
        port.close()
        port.close()
    with pytest.raises(OSError, match="refused"):
        emulation.inject(host, 31001, "state")


def _fixed_world() -> FixedWorld:
    return FixedWorld(wrench=(1.0, -2.0, -3.5, 0.01, -0.02, 0.03))


def _netft(host: str, silence: float) -> tuple[Any, Any, Callable[..., Any]]:
    emulator = NetFtEmulator(NetFtEmulatorConfig(host=host), _fixed_world(), CLOCK)
    driver = NetFtDriver(NetFtConfig(host, 8080, silence=silence), CLOCK)
    return emulator, driver, emulator.faults.inject


def _xela(host: str, silence: float) -> tuple[Any, Any, Callable[..., Any]]:
    settings = XelaEmulatorConfig(XelaConfig(rate_hz=200.0), host=host)
    counts = 34000.0 + np.arange(48).reshape(16, 3)
    emulator = XelaEmulator(settings, _fixed_world(), CLOCK, lambda state: counts)
    driver = XelaDriver(XelaConfig(f"ws://{host}:5000", silence=silence), CLOCK)
    return emulator, driver, emulator.faults.inject


def _mjpeg(host: str, silence: float) -> tuple[Any, Any, Callable[..., Any]]:
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    source = rendered(lambda state: image)
    config = MjpegConfig(f"http://{host}:8090/", rate_hz=60.0, silence=silence)
    emulator = MjpegEmulator(MjpegEmulatorConfig(config, host=host), source, None, CLOCK)
    return emulator, MjpegDriver(config, CLOCK), emulator.faults.inject


def _arm(host: str, silence: float) -> tuple[Any, Any, Callable[..., Any]]:
    controller = Controller(flange_pose(np.array(POSTURE)), np.zeros(6))
    emulator = ArmEmulator(host, controller, CLOCK)
    driver = RtdePoseDriver(ArmConfig(host=host, rate_hz=500.0), CLOCK)
    return emulator, driver, emulator.apply


DEVICES = {"force": _netft, "taxels": _xela, "camera": _mjpeg, "arm": _arm}


@contextmanager
def streaming(
    device: str, host: str, silence: float = 60.0
) -> Iterator[tuple[Any, Callable[..., Any]]]:
    emulator, driver, inject = DEVICES[device](host, silence)
    with running(emulator), opening(driver):
        collect(driver, 3)
        yield driver, inject


def until_lost(driver: Any) -> list[dict[str, Any]]:
    samples: list[dict[str, Any]] = []
    for _ in range(100_000):
        try:
            samples += driver.read(1.0)
        except DeviceLost as error:
            return [*samples, {"lost": str(error)}]
    raise AssertionError("never lost")


def until_rejected(driver: Any, reason: str, count: int) -> list[dict[str, Any]]:
    """Return the samples read meanwhile; those sent before a fault may still wait to be read."""
    samples: list[dict[str, Any]] = []
    while driver.rejected[reason] < count:
        samples += driver.read(1.0)
    return samples


@pytest.mark.parametrize("device", sorted(DEVICES))
@pytest.mark.parametrize(
    "fault", [fault for fault in FAULTS if fault in ("freeze", "garbage", "wrong_units", "unplug")]
)
def test_a_line_that_cannot_be_trusted_is_device_lost_and_nothing_of_it_is_kept(
    device: str, fault: str, host: str
) -> None:
    values = {"seconds": 300.0} if fault == "freeze" else {}
    # Only silence tells that nobody sends datagrams any more.
    silent = fault == "freeze" or (device, fault) == ("force", "unplug")
    with streaming(device, host, 1.0 if silent else 60.0) as (driver, inject):
        before = collect(driver, 3)[-1]["value"]
        inject(fault, **values)
        *kept, end = until_lost(driver)
        assert len(end["lost"]) > 20
        if device == "camera":
            assert {len(sample["value"]) > 10_000 for sample in kept} <= {True}
        elif (device, fault) == ("force", "wrong_units"):
            # Records have no units: the page states them once per second, and the reason states
            # the time from which values are in doubt.
            assert "force_unit from N to lbf" in end["lost"]
            since_ns = int(end["lost"].split("t_ns = ")[1].split()[0])
            wrong = [sample for sample in kept if abs(sample["value"][0] - 1.0) > 0.01]
            assert wrong
            assert min(sample["t_ns"] for sample in wrong) > since_ns
        else:
            for sample in kept:
                assert np.allclose(sample["value"], before, atol=1e-3)


@pytest.mark.parametrize(
    ("fault", "reason", "device"),
    [("reorder", "late", device) for device in ("force", "taxels", "arm")]
    + [("duplicate", "repeated", device) for device in sorted(DEVICES)],
)
def test_late_messages_are_left_out_and_missing_and_repeated_ones_left_out(
    fault: str, reason: str, device: str, host: str
) -> None:
    with streaming(device, host) as (driver, inject):
        inject(fault, every=5)
        samples = until_rejected(driver, reason, 5)
        if device == "camera":
            assert len({sample["value"] for sample in samples}) == len(samples)
        else:
            number = "device_t" if device == "arm" else "seq"
            numbers = [float(sample[number]) for sample in samples]
            assert all(a < b for a, b in itertools.pairwise(numbers))
            late = driver.rejected["late"]
            assert driver.dropped >= late if reason == "late" else driver.dropped == 0


@pytest.mark.parametrize("device", ["force", "taxels", "camera"])
def test_three_bad_messages_are_counted_and_the_stream_goes_on(device: str, host: str) -> None:
    with streaming(device, host) as (driver, inject):
        inject("garbage", messages=3)
        # A busy machine delivers what was sent before in bursts.
        for _ in range(20):
            collect(driver, 5)
            if driver.rejected["corrupt"] >= 3:
                break
        collect(driver, 5)
        # A camera skips frames for a late reader, so on a busy machine bad ones too.
        assert driver.rejected["corrupt"] in ((1, 2, 3) if device == "camera" else (3,))


@pytest.mark.parametrize("device", sorted(DEVICES))
def test_an_unplugged_device_refuses_everybody_until_plugged_in(device: str, host: str) -> None:
    emulator, driver, inject = DEVICES[device](host, 60.0)
    with running(emulator):
        inject("unplug")
        with pytest.raises(DeviceLost), opening(driver, 0.5):
            pass
        inject("replug")
        with opening(driver):
            assert collect(driver, 3)
