"""The gripper's driver and emulator over a pty, and the emulator with a third-party client."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import minimalmodbus
import pytest
import serial

from rig.core.clock import FakeClock, SystemClock
from rig.core.config import build
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.gripper.robotiq import RobotiqDriver, swap_held
from rig.devices.gripper.robotiq_emulator import ACTIVATION, Fingers, RobotiqEmulator
from rig.devices.gripper.robotiq_wire import (
    ACTIVATING,
    ACTIVE,
    AT_POSITION,
    MOVING,
    SILENT_FAULT,
    STOPPED_CLOSING,
    GripperCommand,
    parse_status,
)
from rig.devices.gripper.settings import RobotiqConfig

CLOSE = GripperCommand(go=True, position=255, speed=255, force=255)


@pytest.fixture(name="emulator")
def running(tmp_path: Path) -> Iterator[RobotiqEmulator]:
    clock = SystemClock()
    emulator = RobotiqEmulator(
        Fingers(clock, object_at=120, holding=True), tmp_path / "gripper.tty", clock
    )
    emulator.start()
    yield emulator
    emulator.close()
    emulator.close()


@pytest.fixture(name="driver")
def opened(emulator: RobotiqEmulator) -> Iterator[RobotiqDriver]:
    driver = RobotiqDriver(RobotiqConfig(emulator.address, speed=255, answer=0.5), SystemClock())
    driver.open(1.0)
    yield driver
    driver.close()
    driver.close()


@pytest.fixture(name="public")
def public_client(emulator: RobotiqEmulator) -> Iterator[minimalmodbus.Instrument]:
    client = minimalmodbus.Instrument(emulator.address, 9)
    assert client.serial is not None
    client.serial.baudrate = 115200
    client.serial.timeout = 1.0
    yield client
    client.serial.close()


# The fingers, with simulated time.


def test_activation_takes_its_time_and_opens_the_fingers() -> None:
    clock = FakeClock()
    fingers = Fingers(clock, object_at=None)
    fingers.obey(GripperCommand())
    assert fingers.status().state == ACTIVATING
    clock.advance(0.99 * ACTIVATION)
    assert fingers.status().state == ACTIVATING
    clock.advance(0.02 * ACTIVATION)
    assert fingers.status().state == ACTIVE


def test_a_command_before_the_activation_is_a_fault_and_moves_nothing() -> None:
    fingers = Fingers(FakeClock(), object_at=None)
    fingers.obey(GripperCommand())
    fingers.obey(CLOSE)
    assert fingers.status().fault == 5
    assert fingers.status().position == 3


def test_fingers_move_then_hold_then_find_nothing_when_the_object_is_gone() -> None:
    clock = FakeClock()
    fingers = Fingers(clock, object_at=120)
    fingers.obey(GripperCommand())
    clock.advance(2.0)
    fingers.status()
    fingers.obey(CLOSE)
    clock.advance(0.1)
    assert (fingers.status().object, fingers.status().position) == (MOVING, 48)
    clock.advance(0.5)
    assert (fingers.status().object, fingers.status().position) == (STOPPED_CLOSING, 120)
    fingers.lose_grip()
    clock.advance(0.1)
    assert fingers.status().object == MOVING
    clock.advance(0.5)
    assert (fingers.status().object, fingers.status().position) == (AT_POSITION, 230)


def test_fingers_open_away_from_what_they_held() -> None:
    clock = FakeClock()
    fingers = Fingers(clock, object_at=120, holding=True)
    fingers.obey(GripperCommand(go=True, position=0, speed=255))
    clock.advance(1.0)
    assert (fingers.status().object, fingers.status().position) == (AT_POSITION, 3)


def test_a_silence_of_more_than_a_second_is_told_once() -> None:
    clock = FakeClock()
    fingers = Fingers(clock, object_at=120, holding=True)
    clock.advance(1.0)
    fingers.heard()
    assert fingers.status().fault == 0
    clock.advance(1.1)
    fingers.heard()
    assert fingers.status().fault == SILENT_FAULT
    assert fingers.status().fault == 0


# A third-party client: the emulator must not agree only with our own driver.


def test_minimalmodbus_reads_the_grip_by_both_functions(
    public: minimalmodbus.Instrument,
) -> None:
    for function in (3, 4):
        status = parse_status(public.read_registers(0x07D0, 3, functioncode=function))
        assert status.holding
        assert status.position == 120


def test_minimalmodbus_opens_and_closes_the_fingers(
    public: minimalmodbus.Instrument, emulator: RobotiqEmulator
) -> None:
    public.write_registers(0x03E8, [0x0900, 0x0000, 0xFFFF])
    clock = SystemClock()
    limit_ns = clock.now_ns() + 240_000_000_000
    while parse_status(public.read_registers(0x07D0, 3)).object != AT_POSITION:
        assert clock.now_ns() < limit_ns
    public.write_registers(0x03E8, [0x0900, 0x00FF, 0xFFFF])
    while not parse_status(public.read_registers(0x07D0, 3)).holding:
        assert clock.now_ns() < limit_ns


@pytest.mark.parametrize(
    ("ask", "error"),
    [
        (lambda public: public.read_registers(0x0000, 3), minimalmodbus.IllegalRequestError),
        (lambda public: public.read_registers(0x07D0, 4), minimalmodbus.IllegalRequestError),
        (lambda public: public.write_registers(0x03E8, [0]), minimalmodbus.IllegalRequestError),
        (lambda public: public.read_bit(0), minimalmodbus.IllegalRequestError),
    ],
)
def test_minimalmodbus_understands_the_refusals(
    ask, error: type[Exception], public: minimalmodbus.Instrument
) -> None:
    with pytest.raises(error):
        ask(public)


def test_another_slave_address_is_met_with_silence(public: minimalmodbus.Instrument) -> None:
    public.address = 8
    with pytest.raises(minimalmodbus.NoResponseError):
        public.read_registers(0x07D0, 3)
    public.address = 9
    assert parse_status(public.read_registers(0x07D0, 3)).holding


def test_a_corrupt_request_is_met_with_silence_and_the_next_one_is_answered(
    emulator: RobotiqEmulator,
) -> None:
    with serial.Serial(emulator.address, 115200, timeout=0.2) as port:
        port.write(bytes.fromhex("09 03 07 d0 00 03 04 0f"))
        assert port.read(1) == b""
        port.timeout = 60.0
        port.write(bytes.fromhex("09 03 07 d0 00 03 04 0e"))
        assert len(port.read(11)) == 11


# The driver.


def test_the_driver_opens_closes_and_tells_what_it_holds(driver: RobotiqDriver) -> None:
    assert driver.status().holding
    assert driver.open_fingers().object == AT_POSITION
    held = driver.close_fingers()
    assert held.holding
    assert held.position == 120
    assert driver.describe()["status"].startswith("active, holds")


def test_the_driver_activates_a_gripper_that_is_reset(tmp_path: Path) -> None:
    clock = SystemClock()
    emulator = RobotiqEmulator(Fingers(clock, object_at=120), tmp_path / "tty", clock)
    emulator.start()
    try:
        with RobotiqDriver(RobotiqConfig(emulator.address, speed=255), clock) as driver:
            driver.open(1.0)
            with pytest.raises(DeviceLost, match="activate it first"):
                driver.close_fingers()
            assert driver.activate(10.0).state == ACTIVE
            assert driver.close_fingers().holding
    finally:
        emulator.close()


def test_opening_moves_nothing_and_forgets_an_old_silence(
    emulator: RobotiqEmulator,
) -> None:
    emulator.fingers.fail(SILENT_FAULT)
    with RobotiqDriver(RobotiqConfig(emulator.address), SystemClock()) as driver:
        driver.open(1.0)
        status = driver.status()
    assert status.fault == 0
    assert status.holding


@pytest.mark.parametrize(
    ("fault", "values", "word"),
    [
        ("freeze", {}, "no answer in 500 ms"),
        ("garbage", {}, "gripper at"),
        ("unplug", {}, "cable"),
    ],
)
def test_a_broken_line_is_a_lost_device_and_a_mended_one_is_not(
    fault: str,
    values: dict[str, float],
    word: str,
    emulator: RobotiqEmulator,
    driver: RobotiqDriver,
) -> None:
    emulator.inject(fault, **values)
    with pytest.raises(DeviceLost, match=word):
        ask_often(driver)
    emulator.inject("clear")
    if fault == "unplug":
        wait_for(Path(emulator.address))
        driver.open(1.0)
    assert driver.status().holding


def ask_often(driver: RobotiqDriver) -> None:
    """Poll until the device is lost: the pty closes shortly after the fault was requested."""
    for _ in range(200):
        driver.status()


def wait_for(path: Path) -> None:
    clock = SystemClock()
    limit_ns = clock.now_ns() + 240_000_000_000
    while not path.exists():
        assert clock.now_ns() < limit_ns
        clock.sleep_until(clock.now_ns() + 5_000_000)


def test_a_reply_that_trickles_in_has_one_time_limit(
    emulator: RobotiqEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SystemClock()

    def trickle(reply: bytes) -> Iterator[bytes]:
        for byte in reply:
            clock.sleep_until(clock.now_ns() + 90_000_000)
            yield bytes([byte])

    with RobotiqDriver(RobotiqConfig(emulator.address, answer=0.5), clock) as driver:
        driver.open(60.0)
        # Five bytes take less than the limit, as do the other six, but not all together: with a
        # limit for each the reply would be read.
        monkeypatch.setattr(emulator.faults, "passed", trickle)
        with pytest.raises(DeviceLost):
            driver.status()


def test_a_port_that_is_not_there_is_a_lost_device_that_says_where_to_look(tmp_path: Path) -> None:
    driver = RobotiqDriver(RobotiqConfig(str(tmp_path / "none")), SystemClock())
    with pytest.raises(DeviceLost, match="/dev/serial/by-id"):
        driver.open(0.1)


def test_nobody_at_the_address_is_a_lost_device(emulator: RobotiqEmulator) -> None:
    driver = RobotiqDriver(RobotiqConfig(emulator.address, slave=8), SystemClock())
    with pytest.raises(DeviceLost, match="address 8"):
        driver.open(0.1)
    with pytest.raises(DeviceLost, match="not open"):
        driver.status()


def test_a_fault_of_the_gripper_ends_a_movement_with_its_meaning(
    emulator: RobotiqEmulator, driver: RobotiqDriver
) -> None:
    emulator.inject("fail", code=14)
    with pytest.raises(DeviceLost, match="overcurrent"):
        driver.open_fingers()


def test_an_unknown_fault_or_a_missing_value_is_refused(emulator: RobotiqEmulator) -> None:
    with pytest.raises(ValueError, match="known"):
        emulator.inject("explode")
    with pytest.raises(KeyError):
        emulator.inject("slip")


def test_a_bench_file_that_makes_no_sense_is_refused() -> None:
    for key, value in (("rate_hz", 0.0), ("slave", 300), ("position_tolerance", 0)):
        with pytest.raises(ConfigError, match=key):
            build(RobotiqConfig, {"kind": "robotiq_2f", "port": "x", key: value}, "bench.gripper")


# Exchanging the gripped indenter.


def test_a_swap_waits_until_something_is_between_the_fingers(
    emulator: RobotiqEmulator, driver: RobotiqDriver
) -> None:
    reported: list[str] = []

    def say(line: str) -> None:
        reported.append(line)
        if len(reported) == 1:
            emulator.inject("lose_grip")
        if len(reported) == 3:
            emulator.inject("insert", at=60)

    status = swap_held(driver, "indenter prism", SystemClock(), say, pause=0.01, speed=255)
    assert status.holding
    assert status.position == 60
    assert reported[0].startswith("gripper: opens in")
    assert [line.startswith("gripper: put indenter prism between") for line in reported[1:3]] == [
        True,
        True,
    ]


def test_a_swap_nobody_comes_for_is_device_lost(
    emulator: RobotiqEmulator, driver: RobotiqDriver
) -> None:
    emulator.inject("lose_grip")
    short = {"pause": 0.01, "patience": 0.5}
    with pytest.raises(DeviceLost, match=r"nothing to hold in 0\.5 s; indenter prism"):
        swap_held(driver, "indenter prism", SystemClock(), lambda _: None, speed=255, **short)
