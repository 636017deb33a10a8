"""The Net F/T sensor: its wire format, times of arrival, and the driver against the emulator."""

import contextlib
import itertools
import socket
import struct
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.drivers import FixedWorld, collect, opening, running

from benchmarks.fake_clock import FakeClock
from rig.core.clock import SECOND_NS, ClockAnchor, SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.force.netft import NetFtDriver, StampedSocket
from rig.devices.force.netft_emulator import NetFtEmulator, NetFtEmulatorConfig
from rig.devices.force.netft_wire import (
    COMMAND_REALTIME,
    ERROR_MASK,
    FORCE_UNITS,
    RECORD,
    SATURATION_MASK,
    TORQUE_UNITS,
    Page,
    emit_page,
    emit_request,
    parse_page,
    parse_request,
    status_text,
)
from rig.devices.force.settings import NetFtConfig

CLOCK = SystemClock()
WRENCH = (1.0, -2.0, -3.5, 0.01, -0.02, 0.03)
UINT32 = st.integers(0, 2**32 - 1)
POSITIVE = st.floats(1e-6, 1e12)
SO_TIMESTAMPNS = 35


# The wire format: requests, records, the settings page, status words.


@given(st.integers(0, 2**16 - 1), UINT32)
def test_parsing_a_request_undoes_emitting_it(command: int, samples: int) -> None:
    assert parse_request(emit_request(command, samples)) == (command, samples)


@given(
    st.builds(
        Page,
        product=st.just("Net F/T"),
        serial=st.sampled_from(["", "FT12345"]),
        runstat=UINT32,
        counts_per_force=POSITIVE,
        counts_per_torque=POSITIVE,
        force_unit=st.sampled_from(sorted(FORCE_UNITS)),
        torque_unit=st.sampled_from(sorted(TORQUE_UNITS)),
        rate_hz=st.integers(1, 7000),
    )
)
def test_parsing_a_page_undoes_emitting_it(page: Page) -> None:
    assert parse_page(emit_page(page)) == page


def test_a_request_to_stream_is_these_eight_bytes() -> None:
    assert emit_request(COMMAND_REALTIME).hex() == "1234000200000000"


def test_a_record_is_thirty_six_big_endian_bytes() -> None:
    packet = bytes.fromhex("00000001000000070000000000000001ffffffff" + "00000002" * 4)
    assert RECORD.unpack(packet) == (1, 7, 0, 1, -1, 2, 2, 2, 2)


@given(st.binary(max_size=80))
def test_any_other_packet_is_no_request(packet: bytes) -> None:
    assert (parse_request(packet) is not None) == (
        len(packet) == 8 and packet.startswith(b"\x12\x34")
    )


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"<html", "not XML"),
        (b"<netFTApi><cfgcpf>1</cfgcpf></netFTApi>", "missing"),
        (emit_page(Page()).replace(b">1000<", b">fast<"), "fast"),
    ],
)
def test_a_page_of_something_else_is_refused(content: bytes, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        parse_page(content)


def test_n_mm_is_a_thousandth_of_n_m() -> None:
    assert Page(torque_unit="N-mm").scale() == pytest.approx((1e-6, 1e-9))
    assert Page(torque_unit="N-m").scale() == pytest.approx((1e-6, 1e-6))


def test_a_pound_force_inch_is_the_pound_force_times_the_inch() -> None:
    assert TORQUE_UNITS["lbf-in"] == pytest.approx(FORCE_UNITS["lbf"] * 0.0254)
    assert TORQUE_UNITS["lbf-ft"] == pytest.approx(FORCE_UNITS["lbf"] * 0.3048)


@pytest.mark.parametrize("page", [Page(force_unit="dyn"), Page(torque_unit="Nm")])
def test_an_unknown_unit_is_refused_with_the_known_ones(page: Page) -> None:
    with pytest.raises(ConfigError, match=r"known: .*N"):
        page.scale()


def test_status_words_are_told_in_words() -> None:
    assert status_text(0) == "ok"
    assert status_text(0x80010000) == "monitor condition latched"
    assert status_text(1 << 31 | 1 << 17 | 1 << 2) == "saturation or A/D error; temperature error"
    assert "0x00008000" in status_text(1 << 15)


def test_the_latched_monitor_condition_and_saturation_are_not_among_the_errors() -> None:
    assert 0x80010000 & ERROR_MASK == 0
    assert SATURATION_MASK & ERROR_MASK == 0
    assert 1 << 28 & ERROR_MASK


# The kernel's time of arrival, converted to the monotonic clock.


@pytest.fixture(name="pair")
def connected_sockets() -> Iterator[tuple[socket.socket, socket.socket]]:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60.0)
        sender.connect(receiver.getsockname())
        yield receiver, sender


def test_packets_that_waited_keep_the_time_they_came(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    receiver, sender = pair
    stamped = StampedSocket(receiver, CLOCK)
    # The kernel begins to stamp packets some time after the request.
    for _ in range(1000):
        sender.send(b"first")
        sent_ns = time.time_ns()
        threading.Event().wait(0.02)
        apart_ns = time.time_ns() - sent_ns
        sender.send(b"second")
        (first, first_ns), (second, second_ns) = stamped.receive(64), stamped.receive(64)
        assert (first, second) == (b"first", b"second")
        if second_ns - first_ns >= apart_ns:
            return
    raise AssertionError("packets have the time at which they were read")


@pytest.mark.parametrize(
    ("stamped_s", "arrived_s"), [(2, 102), (5, 105), (6, 105), (-6, 105)],
    ids=["while it waited", "now", "ahead", "too old"],
)  # fmt: skip
def test_a_stamp_is_converted_exactly_and_one_that_cannot_be_is_not_used(
    stamped_s: int, arrived_s: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    anchor = ClockAnchor(100 * SECOND_NS, 9000 * SECOND_NS, "boot")
    monkeypatch.setattr(ClockAnchor, "take", lambda: anchor)
    stamp = (socket.SOL_SOCKET, SO_TIMESTAMPNS, struct.pack("@ll", 9000 + stamped_s, 7))
    udp: Any = SimpleNamespace(
        setsockopt=lambda *_: None, recvmsg=lambda *_: (b"packet", [stamp], 0, None)
    )
    clock = FakeClock(105 * SECOND_NS + 7)
    assert StampedSocket(udp, clock).receive(64) == (b"packet", arrived_s * SECOND_NS + 7)


def test_a_clock_that_is_not_the_systems_stamps_with_its_own_time(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    receiver, sender = pair
    clock = FakeClock(7 * SECOND_NS)
    stamped = StampedSocket(receiver, clock)
    sender.send(b"packet")
    assert stamped.receive(64) == (b"packet", clock.now_ns())


def test_a_time_out_is_the_sockets_own(pair: tuple[socket.socket, socket.socket]) -> None:
    pair[0].settimeout(0.01)
    with pytest.raises(TimeoutError):
        StampedSocket(pair[0], CLOCK).receive(64)


# The driver against the emulator.


def emulated(
    host: str, page: Page | None = None, **options: Any
) -> AbstractContextManager[NetFtEmulator]:
    config = NetFtEmulatorConfig(host=host, page=page or Page(), **options)
    return running(NetFtEmulator(config, FixedWorld(wrench=WRENCH), CLOCK))


def opened(
    host: str, rate_hz: float = 1000.0, silence: float = 20.0
) -> AbstractContextManager[NetFtDriver]:
    driver = NetFtDriver(NetFtConfig(host, 8080, rate_hz=rate_hz, silence=silence), CLOCK)
    return opening(driver)


def number(packet: bytes) -> int:
    return int(struct.unpack(">I", packet[:4])[0])


def numbered(packet: bytes, sequence: int) -> Iterable[bytes]:
    return (struct.pack(">I", sequence & 0xFFFFFFFF) + packet[4:],)


@pytest.mark.parametrize("units", [("N", "N-mm"), ("N", "N-m"), ("lbf", "lbf-in"), ("kN", "kN-m")])
def test_the_wrench_is_in_newton_and_newton_metre_whatever_the_box_counts_in(
    host: str, units: tuple[str, str]
) -> None:
    page = Page(force_unit=units[0], torque_unit=units[1], counts_per_torque=2e6)
    with emulated(host, page), opened(host) as driver:
        description = driver.describe()
        assert collect(driver, 1)[0]["value"] == pytest.approx(WRENCH, rel=1e-3)
        assert (description["force_unit"], description["torque_unit"]) == units


def test_the_rate_is_set_and_read_back(host: str) -> None:
    with emulated(host, Page(rate_hz=7000)) as emulator, opened(host, 500.0) as driver:
        assert emulator.page.rate_hz == 500
        assert driver.describe()["rate_hz"] == 500.0


def test_a_refused_rate_is_a_config_error(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NetFtEmulator, "set_rate", lambda *_: None)
    refused = pytest.raises(ConfigError, match="asked 1000 Hz, got 200 Hz")
    with emulated(host, Page(rate_hz=200)), refused, opened(host):
        pass


def test_a_box_that_reports_an_error_is_lost_and_says_which(host: str) -> None:
    with (
        emulated(host, Page(runstat=1 << 31 | 1 << 28)),
        pytest.raises(DeviceLost, match="analog board error"),
        opened(host),
    ):
        pass


def test_a_latched_monitor_condition_is_only_a_status(host: str) -> None:
    with emulated(host, Page(runstat=0x80010000)), opened(host) as driver:
        assert collect(driver, 1)[0]["status"] == 0x80010000


def test_lost_packets_are_counted_exactly(host: str) -> None:
    with emulated(host) as emulator:
        emulator.faults.passed = lambda packet: (packet,) if number(packet) % 10 else ()
        with opened(host) as driver:
            numbers = [sample["seq"] for sample in collect(driver, 200)]
            assert not [each for each in numbers if each % 10 == 0]
            lost = sum(b - a - 1 for a, b in itertools.pairwise(numbers))
            assert 0 < lost <= driver.dropped


def test_packets_of_another_length_are_counted_and_left_out(host: str) -> None:
    with emulated(host) as emulator:
        emulator.faults.passed = lambda packet: (packet, packet[:-1], b"")
        with opened(host) as driver:
            numbers = [sample["seq"] for sample in collect(driver, 50)]
            assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
            assert driver.rejected["corrupt"] >= 98


def test_the_sequence_goes_on_past_two_to_the_32(host: str) -> None:
    start = 2**32 - 20
    with emulated(host) as emulator:
        emulator.faults.passed = lambda packet: numbered(packet, number(packet) + start)
        with opened(host) as driver:
            numbers = [sample["seq"] for sample in collect(driver, 100)]
            assert numbers == list(range(start + 1, start + 1 + len(numbers)))
            assert driver.dropped == 0


def test_a_sequence_that_begins_anew_is_device_lost(host: str) -> None:
    with emulated(host) as emulator:
        emulator.faults.passed = lambda packet: numbered(
            packet, number(packet) + (5000 if number(packet) < 50 else 0)
        )
        with opened(host) as driver, pytest.raises(DeviceLost, match="went back"):
            collect(driver, 1000)


def test_a_client_that_takes_the_stream_is_named_as_a_cause_of_silence(host: str) -> None:
    with emulated(host), opened(host, silence=1.0) as robbed:
        collect(robbed, 5)
        with opened(host) as thief:
            with pytest.raises(DeviceLost, match="no other client"):
                collect(robbed, 100_000)
            assert collect(thief, 5)


def test_closing_stops_the_stream(host: str) -> None:
    sent: list[int] = []

    def noted(packet: bytes) -> Iterable[bytes]:
        sent.append(number(packet))
        return (packet,)

    with emulated(host) as emulator:
        emulator.faults.passed = noted
        # The second stream counts from one again, since the first one had ended.
        for _ in range(2):
            with opened(host) as driver:
                collect(driver, 5)
        assert sent.count(1) == 2


class LateClock(FakeClock):
    """Wakes 5 ms late, as on a machine whose cores are taken."""

    def sleep_until(self, deadline_ns: int) -> None:
        super().sleep_until(deadline_ns + 5_000_000)


def test_records_that_the_machine_is_late_for_are_sent_all_the_same(host: str) -> None:
    clock, sent = LateClock(), []

    def noted(packet: bytes) -> Iterable[bytes]:
        sent.append(clock.now_ns())
        return (packet,)

    emulator = NetFtEmulator(NetFtEmulatorConfig(host=host), FixedWorld(), clock)
    emulator.faults.passed = noted
    with running(emulator), opened(host) as driver:
        collect(driver, 100)
    # One for each time it wakes would be less than 200 in a second.
    assert len(sent) == pytest.approx(1 + (sent[-1] - sent[0]) / 1e6, abs=7)


def test_noise_has_the_asked_spread(host: str) -> None:
    with emulated(host, noise=0.1, seed=3), opened(host) as driver:
        values = np.array([sample["value"] for sample in collect(driver, 400)])
        assert values[:, 2].std() == pytest.approx(0.1, rel=0.3)
        assert values[:, 5].std() == pytest.approx(0.0005, rel=0.3)


def test_an_independent_client_reads_the_same_from_the_emulator_and_can_bias_it(host: str) -> None:
    pynetft = pytest.importorskip("pynetft", reason="the oracle client is not installed")
    with emulated(host), pynetft.Client(pynetft.Config(sensor_host=host, http_port=8080)) as client:
        stream = client.samples(timeout=60.0)
        samples = list(itertools.islice(stream, 50))
        assert samples[-1].force == pytest.approx(WRENCH[:3])
        assert samples[-1].torque == pytest.approx([1e3 * value for value in WRENCH[3:]])
        numbers = [sample.rdt_sequence for sample in samples]
        assert all(a < b for a, b in itertools.pairwise(numbers))
        client.bias()
        zero = pytest.approx((0.0, 0.0, 0.0))
        assert any(sample.force == zero for sample in itertools.islice(stream, 2000))


@contextmanager
def dripping_page(host: str, head: bytes, drop: bytes) -> Iterator[int]:
    """Serve an answer that never ends: `head`, then `drop` every 20 ms; yield the port."""
    ending = threading.Event()
    with socket.create_server((host, 0)) as server:

        def serve() -> None:
            with contextlib.suppress(OSError):
                client, _ = server.accept()
                with client:
                    client.sendall(head)
                    while not ending.wait(0.02):
                        client.sendall(drop)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            ending.set()
            thread.join()


@pytest.mark.parametrize(
    ("head", "drop"),
    [
        (b"", b"H"),
        (b"HTTP/1.1 200 OK\r\n", b"x"),
        (b"HTTP/1.1 200 OK\r\n\r\n", b"<"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n", b"<"),
        (b"", b""),
    ],
    ids=["status", "header", "body", "length", "silent"],
)
def test_a_page_that_drips_ends_at_the_time_limit(host: str, head: bytes, drop: bytes) -> None:
    with dripping_page(host, head, drop) as port:
        driver = NetFtDriver(NetFtConfig(host=host, http_port=port), CLOCK)
        with pytest.raises(DeviceLost, match="timed out"):
            driver.open(0.3)
        driver.close()
