"""The gripper's driver and emulator over a pty, and the emulator with a third-party client."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import minimalmodbus
import pytest
import serial
from support.drivers import running
from support.waiting import until

from benchmarks.fake_clock import FakeClock
from rig.core.clock import SystemClock
from rig.core.config import build
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.gripper.robotiq import RobotiqDriver, swap_held
from rig.devices.gripper.robotiq_emulator import ACTIVATION, Fingers, RobotiqEmulator
from rig.devices.gripper.robotiq_wire import (
    ACTIVATING,
    ACTIVE,
    AT_POSITION,
    MOVING,
    READ_INPUT,
    REGISTERS,
    SILENT_FAULT,
    STATUS_ADDRESS,
    STOPPED_CLOSING,
    GripperCommand,
    GripperStatus,
    ModbusRequest,
    emit_reply,
    parse_status,
)
from rig.devices.gripper.settings import RobotiqConfig

CLOSE = GripperCommand(go=True, position=255, speed=255, force=255)


# Longest wait for an answer that comes [s].
PATIENCE = 60.0


@pytest.fixture
def clock() -> FakeClock:
    """The clock of fingers and driver: the driver's pauses move it, a busy machine does not."""
    return FakeClock()


@pytest.fixture(name="emulator")
def running_emulator(clock: FakeClock, tmp_path: Path) -> Iterator[RobotiqEmulator]:
    fingers = Fingers(clock, object_at=120, holding=True)
    with running(RobotiqEmulator(fingers, tmp_path / "gripper.tty", SystemClock())) as emulator:
        yield emulator
        emulator.close()  # which may be called twice


@pytest.fixture(name="driver")
def opened(emulator: RobotiqEmulator, clock: FakeClock) -> Iterator[RobotiqDriver]:
    driver = RobotiqDriver(RobotiqConfig(emulator.address, speed=255, answer=PATIENCE), clock)
    driver.open(1.0)
    yield driver
    driver.close()
    driver.close()


@pytest.fixture(name="public")
def public_client(emulator: RobotiqEmulator) -> Iterator[minimalmodbus.Instrument]:
    client = minimalmodbus.Instrument(emulator.address, 9)
    assert client.serial is not None
    client.serial.baudrate = 115200
    client.serial.timeout = PATIENCE
    yield client
    client.serial.close()


# The fingers, with simulated time.


def test_fingers_are_activated_move_hold_lose_what_they_held_and_notice_a_silence() -> None:
    clock = FakeClock()
    fingers = Fingers(clock, object_at=120)

    def after(seconds: float) -> tuple[int, int]:
        clock.advance(seconds)
        return fingers.status().object, fingers.status().position

    fingers.obey(GripperCommand())
    fingers.obey(CLOSE)  # before the activation, which is a fault and moves nothing
    assert (fingers.status().fault, fingers.status().position) == (5, 3)
    fingers.obey(GripperCommand())
    clock.advance(0.99 * ACTIVATION)
    assert fingers.status().state == ACTIVATING
    clock.advance(0.02 * ACTIVATION)
    assert fingers.status().state == ACTIVE
    fingers.obey(CLOSE)
    assert after(0.1) == (MOVING, 48)
    assert after(0.5) == (STOPPED_CLOSING, 120)
    fingers.lose_grip()
    assert after(0.1)[0] == MOVING
    assert after(0.5) == (AT_POSITION, 230)
    held = Fingers(clock, object_at=120, holding=True)
    # A silence of more than a second is a fault once.
    for silence, faults in ((1.0, (0, 0)), (1.1, (SILENT_FAULT, 0))):
        clock.advance(silence)
        held.heard()
        assert (held.status().fault, held.status().fault) == faults
    held.obey(GripperCommand(go=True, position=0, speed=255))
    clock.advance(1.0)
    assert (held.status().object, held.status().position) == (AT_POSITION, 3)


# A third-party client: the emulator must not agree only with our own driver.


def test_minimalmodbus_reads_the_grip_by_both_functions(public: minimalmodbus.Instrument) -> None:
    for function in (3, 4):
        status = parse_status(public.read_registers(0x07D0, 3, functioncode=function))
        assert (status.holding, status.position) == (True, 120)


def test_minimalmodbus_opens_and_closes_the_fingers(
    public: minimalmodbus.Instrument, clock: FakeClock
) -> None:
    def status() -> GripperStatus:
        clock.advance(0.1)
        return parse_status(public.read_registers(0x07D0, 3))

    public.write_registers(0x03E8, [0x0900, 0x0000, 0xFFFF])
    until(lambda: status().object == AT_POSITION)
    public.write_registers(0x03E8, [0x0900, 0x00FF, 0xFFFF])
    until(lambda: status().holding)


@pytest.mark.slow
def test_minimalmodbus_understands_the_refusals(public: minimalmodbus.Instrument) -> None:
    assert public.serial is not None
    public.serial.timeout = 1.0  # it waits for more than a refusal has
    for refused in (
        lambda: public.read_registers(0x0000, 3),
        lambda: public.read_registers(0x07D0, 4),
        lambda: public.write_registers(0x03E8, [0]),
        lambda: public.read_bit(0),
    ):
        with pytest.raises(minimalmodbus.IllegalRequestError):
            refused()


def test_another_slave_address_is_met_with_silence(public: minimalmodbus.Instrument) -> None:
    assert public.serial is not None
    public.address, public.serial.timeout = 8, 0.2
    with pytest.raises(minimalmodbus.NoResponseError):
        public.read_registers(0x07D0, 3)
    public.address, public.serial.timeout = 9, PATIENCE
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


def test_the_driver_activates_a_gripper_that_is_reset(
    emulator: RobotiqEmulator, driver: RobotiqDriver, clock: FakeClock
) -> None:
    emulator.fingers = Fingers(clock, object_at=120)
    with pytest.raises(DeviceLost, match="activate it first"):
        driver.close_fingers()
    assert driver.activate(10.0).state == ACTIVE
    assert driver.close_fingers().holding


def test_opening_moves_nothing_and_forgets_an_old_silence(
    emulator: RobotiqEmulator, driver: RobotiqDriver
) -> None:
    emulator.fingers.fail(SILENT_FAULT)
    driver.open(1.0)
    status = driver.status()
    assert (status.fault, status.holding) == (0, True)


@pytest.mark.parametrize(
    ("fault", "word"),
    [("freeze", "no answer in 500 ms"), ("garbage", "gripper at"), ("unplug", "cable")],
)
def test_a_broken_line_is_a_lost_device_and_a_mended_one_is_not(
    fault: str, word: str, emulator: RobotiqEmulator, driver: RobotiqDriver
) -> None:
    patient = driver._config
    driver._config = replace(patient, answer=0.5)
    emulator.inject(fault)
    with pytest.raises(DeviceLost, match=word):
        # The pty closes shortly after the fault was requested.
        until(lambda: driver.status() is None, 0.0)
    driver._config = patient
    emulator.inject("clear")
    if fault == "unplug":
        until(Path(emulator.address).exists)
        driver.open(1.0)
    assert driver.status().holding


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


class LateClock(FakeClock):
    """Clock of a thread that runs once a second."""

    def now_ns(self) -> int:
        self.advance(1.0)
        return super().now_ns()


def test_a_thread_that_runs_too_late_reads_what_has_come() -> None:
    request = ModbusRequest(9, READ_INPUT, STATUS_ADDRESS, REGISTERS)
    sent = emit_reply(request, (0xB900, 0x00FF, 0x7806))
    reader, writer = os.pipe()
    os.write(writer, sent)
    with os.fdopen(reader, "rb", buffering=0) as port, os.fdopen(writer, "wb"):
        late = RobotiqDriver(RobotiqConfig(port="/dev/null"), LateClock())
        line = SimpleNamespace(fileno=port.fileno, in_waiting=len(sent), read=port.read)
        assert late._reply(line, request) == sent


def test_nobody_at_the_address_or_the_port_is_a_lost_device(
    emulator: RobotiqEmulator, tmp_path: Path
) -> None:
    nowhere = RobotiqDriver(RobotiqConfig(str(tmp_path / "none")), SystemClock())
    driver = RobotiqDriver(RobotiqConfig(emulator.address, slave=8), SystemClock())
    for each, where in ((nowhere, "/dev/serial/by-id"), (driver, "address 8")):
        with pytest.raises(DeviceLost, match=where):
            each.open(0.1)
    with pytest.raises(DeviceLost, match="not open"):
        driver.status()


def test_a_fault_of_the_gripper_ends_a_movement_with_its_meaning(
    emulator: RobotiqEmulator, driver: RobotiqDriver
) -> None:
    for fault, error in (("explode", ValueError), ("slip", KeyError)):
        with pytest.raises(error):
            emulator.inject(fault)
    emulator.inject("fail", code=14)
    with pytest.raises(DeviceLost, match="overcurrent"):
        driver.open_fingers()


def test_a_bench_file_that_makes_no_sense_is_refused() -> None:
    for key, value in (("rate_hz", 0.0), ("slave", 300), ("position_tolerance", 0)):
        with pytest.raises(ConfigError, match=key):
            build(RobotiqConfig, {"kind": "robotiq_2f", "port": "x", key: value}, "bench.gripper")


# Exchanging the gripped indenter.


def test_a_swap_waits_until_something_is_between_the_fingers(
    emulator: RobotiqEmulator, driver: RobotiqDriver, clock: FakeClock
) -> None:
    reported: list[str] = []

    def say(line: str) -> None:
        reported.append(line)
        if len(reported) == 1:
            emulator.inject("lose_grip")
        if len(reported) == 3:
            emulator.inject("insert", at=60)

    status = swap_held(driver, "indenter prism", clock, say, pause=0.01, speed=255)
    assert (status.holding, status.position) == (True, 60)
    assert reported[0].startswith("gripper: opens in")
    assert all(line.startswith("gripper: put indenter prism between") for line in reported[1:3])


def test_a_swap_nobody_comes_for_is_device_lost(
    emulator: RobotiqEmulator, driver: RobotiqDriver, clock: FakeClock
) -> None:
    emulator.inject("lose_grip")
    short = {"pause": 0.01, "patience": 0.5}
    with pytest.raises(DeviceLost, match=r"nothing to hold in 0\.5 s; indenter prism"):
        swap_held(driver, "indenter prism", clock, lambda _: None, speed=255, **short)
