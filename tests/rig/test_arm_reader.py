import socket
import struct
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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

# The protocol.

whole = {
    "BOOL": st.integers(0, 1),
    "UINT8": st.integers(0, 255),
    "UINT32": st.integers(0, 2**32 - 1),
    "INT32": st.integers(-(2**31), 2**31 - 1),
    "UINT64": st.integers(0, 2**64 - 1),
    "DOUBLE": st.floats(allow_nan=False),
    "VECTOR3D": st.tuples(*[st.floats(allow_nan=False)] * 3),
    "VECTOR6D": st.tuples(*[st.floats(allow_nan=False)] * 6),
    "VECTOR6INT32": st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 6),
    "VECTOR6UINT32": st.tuples(*[st.integers(0, 2**32 - 1)] * 6),
}
recipes = st.lists(
    st.sampled_from(sorted(whole)).flatmap(lambda kind: st.tuples(st.just(kind), whole[kind])),
    max_size=8,
)
messages = st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=60)), max_size=6)


@given(recipes)
def test_values_survive_packing(recipe):
    types = tuple(kind for kind, _ in recipe)
    values = [value for _, value in recipe]
    assert rtde.unpack_values(types, rtde.pack_values(types, values)) == values


@given(messages, st.integers(1, 40))
def test_messages_survive_any_cut_of_the_stream(sent, size):
    stream = b"".join(rtde.pack_message(kind, payload) for kind, payload in sent)
    buffer, found = bytearray(), []
    for at in range(0, len(stream), size):
        buffer += stream[at : at + size]
        found += rtde.split_messages(buffer)
    assert found == sent
    assert not buffer


def test_a_message_is_framed_as_the_manual_says():
    assert rtde.pack_message(rtde.Kind.PROTOCOL, b"\x00\x02") == b"\x00\x05V\x00\x02"


def test_an_impossible_size_is_refused():
    with pytest.raises(ValueError, match="size 2"):
        rtde.split_messages(bytearray(b"\x00\x02U..."))


def test_an_output_request_survives_packing_and_drops_the_trailing_comma_of_ur_rtde():
    payload = rtde.pack_output_request(125.0, ["timestamp", "actual_q"])
    assert rtde.unpack_output_request(payload) == (125.0, ["timestamp", "actual_q"])
    assert rtde.unpack_output_request(payload + b",")[1] == ["timestamp", "actual_q"]


def test_a_recipe_reply_survives_packing():
    payload = rtde.pack_recipe(3, ["DOUBLE", "NOT_FOUND"])
    assert rtde.unpack_recipe(payload) == (3, ["DOUBLE", "NOT_FOUND"])


def test_refused_variables_cannot_be_laid_out():
    with pytest.raises(ValueError, match="NOT_FOUND"):
        rtde.layout(("DOUBLE", "NOT_FOUND"))


def test_a_package_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="9 bytes; the recipe has 8"):
        rtde.unpack_values(("DOUBLE",), bytes(9))


def test_every_variable_has_a_known_type():
    sizes = (
        rtde.layout(tuple(rtde.OUTPUTS.values())).size,
        rtde.layout(tuple(rtde.INPUTS.values())).size,
    )
    assert all(sizes)
    assert rtde.layout(("VECTOR6D",)).size == struct.calcsize(">6d")


# The driver against the emulator.


@pytest.fixture
def emulator(host, tmp_path) -> Iterator[ArmEmulator]:
    pose = flange_pose(np.array(POSTURE))
    state = SharedLatest.create(tmp_path / "arm", ARM_TRUTH)
    world = SharedWorld(tmp_path / "world")
    controller = Controller(pose, np.zeros(6))
    emulator = ArmEmulator(host, controller, SystemClock(), state=state, world=world)
    emulator.start()
    yield emulator
    emulator.close()
    emulator.close()
    state.close()
    world.close()


@pytest.fixture
def driver(host) -> Iterator[RtdePoseDriver]:
    driver = RtdePoseDriver(ArmConfig(host=host, rate_hz=500.0), SystemClock())
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
    samples = read(driver, 200)
    threading.Event().wait(0.5)
    # Nothing is lost while nobody reads.
    samples += read(driver, 200)
    found = ticks(samples)
    assert found == list(range(found[0], found[0] + len(found)))
    assert driver.dropped == 0
    times = [sample["t_ns"] for sample in samples]
    assert times == sorted(set(times))
    assert set(samples[0]) == {"t_ns", *COLUMNS.values()}
    assert samples[0]["value"] == pytest.approx(flange_pose(np.array(POSTURE)))


def test_the_controller_divides_its_rate(emulator, host):
    driver = RtdePoseDriver(ArmConfig(host=host, rate_hz=125.0), SystemClock())
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


def test_nobody_there_is_device_lost_with_the_address(driver, host):
    with pytest.raises(DeviceLost, match=rf"{host}:30004.*network cable"):
        driver.open(2.0)
    with pytest.raises(DeviceLost, match="not open"):
        driver.read(0.1)


def test_a_dropped_connection_is_device_lost_after_what_came_before(emulator, driver):
    driver.open(60.0)
    read(driver, 5)
    emulator.apply("drop")
    with pytest.raises(DeviceLost, match=r"closed|lost"):
        read(driver, 10_000)


@pytest.fixture
def imposter(host) -> Iterator[Callable[[bytes], None]]:
    """A server on the RTDE port that answers every request with the same bytes."""
    stopping = threading.Event()
    threads = []
    with socket.create_server((host, rtde.PORT)) as server:

        def serve(answer: bytes) -> None:
            peer, _ = server.accept()
            with peer:
                peer.recv(1 << 16)
                peer.sendall(answer)
                stopping.wait(240)

        def start(answer: bytes) -> None:
            threads.append(threading.Thread(target=serve, args=(answer,)))
            threads[0].start()

        yield start
        stopping.set()
        for thread in threads:
            thread.join()


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (b"", "mute"),
        (b"\x00\x00garbage", "size 0"),
        (b"HTTP/1.1 400 Bad Request\r\n", "mute"),
        (rtde.pack_message(rtde.Kind.PROTOCOL, b"\x00"), "version 2 refused"),
    ],
)
def test_something_else_on_the_port_is_device_lost(imposter, host, answer, reason):
    imposter(answer)
    link = RtdeLink(host, 500.0, SystemClock())
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


def test_a_taken_port_is_an_error_that_leaves_nothing_open(emulator, host):
    second = ArmEmulator(
        host, Controller(flange_pose(np.array(POSTURE)), np.zeros(6)), SystemClock()
    )
    with pytest.raises(OSError, match="in use"):
        second.start()
    second.close()
