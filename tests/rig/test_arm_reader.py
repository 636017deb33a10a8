from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from rig.core.clock import SystemClock
from rig.core.emulation import SharedWorld
from rig.core.errors import DeviceLost
from rig.core.samples import ARM_TRUTH, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.devices.arm import rtde
from rig.devices.arm.emulated_arm import CYCLE, POSTURE, flange_pose
from rig.devices.arm.emulated_controller import Controller
from rig.devices.arm.emulator import ArmEmulator, RtdeClient
from rig.devices.arm.reader import COLUMNS, RtdeLink, RtdePoseDriver
from rig.devices.arm.settings import ArmConfig

HOST = f"127.{10 + os.getpid() // 250 % 100}.{1 + os.getpid() % 250}.1"
# Loopback addresses by process, so that parallel runs do not collide.


@pytest.fixture
def emulator(tmp_path) -> Iterator[ArmEmulator]:
    pose = flange_pose(np.array(POSTURE))
    state = SharedLatest.create(tmp_path / "arm", ARM_TRUTH)
    world = SharedWorld(tmp_path / "world")
    controller = Controller(pose, np.zeros(6))
    emulator = ArmEmulator(HOST, controller, SystemClock(), state=state, world=world)
    emulator.start()
    yield emulator
    emulator.close()
    emulator.close()
    state.close()
    world.close()


@pytest.fixture
def driver() -> Iterator[RtdePoseDriver]:
    driver = RtdePoseDriver(ArmConfig(host=HOST, rate_hz=500.0), SystemClock())
    yield driver
    driver.close()
    driver.close()


def read(driver: RtdePoseDriver, count: int) -> list[dict]:
    samples: list[dict] = []
    while len(samples) < count:
        samples += driver.read(1.0)
    return samples


def ticks(samples: list[dict]) -> list[int]:
    return [round(sample["device_t"] / CYCLE) for sample in samples]


def test_every_package_arrives_in_order(emulator, driver):
    driver.open(60.0)
    samples = read(driver, 500)
    found = ticks(samples)
    assert found == list(range(found[0], found[0] + len(found)))
    assert driver.dropped == 0
    times = [sample["t_ns"] for sample in samples]
    assert times == sorted(set(times))
    assert set(samples[0]) == {"t_ns", *COLUMNS}
    assert samples[0]["value"] == pytest.approx(flange_pose(np.array(POSTURE)))


def test_a_slow_consumer_loses_nothing(emulator, driver):
    driver.open(60.0)
    first = read(driver, 1)
    threading.Event().wait(0.5)
    found = ticks(first + read(driver, 200))
    assert found == list(range(found[0], found[0] + len(found)))


def test_the_controller_divides_its_rate(emulator):
    driver = RtdePoseDriver(ArmConfig(host=HOST, rate_hz=125.0), SystemClock())
    driver.open(60.0)
    found = ticks(read(driver, 50))
    driver.close()
    assert found == list(range(found[0], found[0] + 4 * len(found), 4))
    assert driver.dropped == 0


def test_it_can_be_opened_again(emulator, driver):
    for _ in range(2):
        driver.open(60.0)
        assert read(driver, 3)
        driver.close()
    assert driver.describe()["controller_version"].startswith("5.12.")


def test_missing_packages_are_counted_by_the_controllers_clock(emulator, driver, monkeypatch):
    publish = RtdeClient.publish

    def lossy(client: RtdeClient) -> None:
        if client._controller.tick % 50 not in (7, 8):
            publish(client)

    driver.open(60.0)
    read(driver, 1)
    monkeypatch.setattr(RtdeClient, "publish", lossy)
    found = ticks(read(driver, 300))
    assert driver.dropped >= 10
    assert found[-1] - found[0] + 1 - len(found) <= driver.dropped


def test_nobody_there_is_device_lost_with_the_address(driver):
    with pytest.raises(DeviceLost, match=rf"{HOST}:30004.*network cable"):
        driver.open(2.0)
    with pytest.raises(DeviceLost, match="not open"):
        driver.read(0.1)


def test_a_dropped_connection_is_device_lost_after_what_came_before(emulator, driver):
    driver.open(60.0)
    read(driver, 5)
    emulator.apply("drop")
    with pytest.raises(DeviceLost, match=r"closed|lost"):
        read(driver, 10_000)


def test_silence_is_device_lost(emulator, driver):
    driver.open(60.0)
    read(driver, 5)
    emulator.apply("freeze", seconds=20.0)
    with pytest.raises(DeviceLost, match="no package for"):
        read(driver, 100_000)


@pytest.fixture
def imposter() -> Iterator[Callable[[bytes], None]]:
    """A server on the RTDE port that answers every request with the same bytes."""
    server = socket.create_server((HOST, rtde.PORT))
    stopping = threading.Event()
    threads = []

    def serve(answer: bytes) -> None:
        peer, _ = server.accept()
        with peer:
            peer.recv(1 << 16)
            if answer:
                peer.sendall(answer)
            stopping.wait(240)

    def start(answer: bytes) -> None:
        threads.append(threading.Thread(target=serve, args=(answer,)))
        threads[0].start()

    yield start
    stopping.set()
    for thread in threads:
        thread.join()
    server.close()


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (b"", "mute"),
        (b"\x00\x00garbage", "size 0"),
        (b"HTTP/1.1 400 Bad Request\r\n", "mute"),
        (rtde.pack_message(rtde.Kind.PROTOCOL, b"\x00"), "version 2 refused"),
    ],
)
def test_something_else_on_the_port_is_device_lost(imposter, answer, reason):
    imposter(answer)
    link = RtdeLink(HOST, 500.0, SystemClock())
    with pytest.raises(DeviceLost, match=reason):
        link.open(0.5)
    link.close()


def test_the_emulator_publishes_every_cycles_pose(emulator, driver, tmp_path):
    driver.open(60.0)
    record = SharedLatest.attach(tmp_path / "arm", ARM_TRUTH)
    before = record.count
    sample = read(driver, 100)[-1]
    assert record.count >= before + 90
    newest = record.read()
    assert newest is not None
    assert tuple(newest["pose"]) == sample["value"]
    record.close()


def test_the_worlds_contact_force_can_stop_the_arm(emulator, driver, tmp_path):
    driver.open(60.0)
    assert read(driver, 1)[0]["safety_status"] == 1
    world = SharedLatest.create(tmp_path / "world", WORLD_STATE)
    state = np.zeros((), WORLD_STATE)
    state["wrench"][2] = -200.0
    world.write(state)
    while read(driver, 1)[-1]["safety_status"] == 1:
        pass
    world.close()
    assert "200.0 N" in emulator.apply("state")["reason"]


def test_a_taken_port_is_an_error_that_leaves_nothing_open(emulator):
    second = ArmEmulator(
        HOST, Controller(flange_pose(np.array(POSTURE)), np.zeros(6)), SystemClock()
    )
    with pytest.raises(OSError, match="in use"):
        second.start()
    second.close()
