"""The Net F/T driver against its emulator: units, lost and late packets, errors, oracle."""

from __future__ import annotations

import contextlib
import itertools
import socket
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.drivers import FixedWorld, collect, opening, running

from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.force.netft import NetFtDriver
from rig.devices.force.netft_emulator import NetFtEmulator, NetFtEmulatorConfig
from rig.devices.force.netft_wire import Page
from rig.devices.force.settings import NetFtConfig

CLOCK = SystemClock()
WRENCH = (1.0, -2.0, -3.5, 0.01, -0.02, 0.03)

Fault = Callable[[int, bytes], Iterable[bytes]]


class FaultyNetFt(NetFtEmulator):
    """Emulator that passes each packet and its sequence number to `fault`."""

    fault: Fault | None = None
    rates_are_fixed = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.faults.passed = self._packets

    def _packets(self, packet: bytes) -> Iterable[bytes]:
        (sequence,) = struct.unpack(">I", packet[:4])
        return (packet,) if self.fault is None else self.fault(sequence, packet)

    def set_rate(self, rate_hz: int) -> None:
        if not self.rates_are_fixed:
            super().set_rate(rate_hz)


def emulated(
    host: str, page: Page | None = None, **options: Any
) -> AbstractContextManager[FaultyNetFt]:
    config = NetFtEmulatorConfig(host=host, page=page or Page(), **options)
    emulator = FaultyNetFt(config, FixedWorld(wrench=WRENCH), CLOCK)
    return running(emulator)


def opened(
    host: str, rate_hz: float = 1000.0, silence: float = 20.0
) -> AbstractContextManager[NetFtDriver]:
    driver = NetFtDriver(NetFtConfig(host, 8080, rate_hz=rate_hz, silence=silence), CLOCK)
    return opening(driver)


@pytest.mark.parametrize(
    ("force_unit", "torque_unit"), [("N", "N-mm"), ("N", "N-m"), ("lbf", "lbf-in"), ("kN", "kN-m")]
)
def test_the_wrench_is_in_newton_and_newton_metre_whatever_the_box_counts_in(
    host: str, force_unit: str, torque_unit: str
) -> None:
    page = Page(force_unit=force_unit, torque_unit=torque_unit)
    with emulated(host, page), opened(host) as driver:
        sample = collect(driver, 1)[0]
        description = driver.describe()
        assert sample["value"] == pytest.approx(WRENCH, rel=1e-3)
        assert (description["force_unit"], description["torque_unit"]) == (force_unit, torque_unit)


def test_counts_per_unit_are_honoured(host: str) -> None:
    page = Page(counts_per_force=1e4, counts_per_torque=2e4)
    with emulated(host, page), opened(host) as driver:
        assert collect(driver, 1)[0]["value"] == pytest.approx(WRENCH, abs=1e-4)


def test_an_unknown_unit_is_refused(host: str) -> None:
    page = Page(force_unit="N", torque_unit="N-mm")
    with emulated(host, page) as emulator:
        emulator.page = replace(page, torque_unit="stone-ft")
        with pytest.raises(ConfigError, match=r"stone-ft.*known: .*N-mm"), opened(host):
            pass


def test_the_rate_is_set_and_read_back(host: str) -> None:
    with emulated(host, Page(rate_hz=7000)) as emulator, opened(host, 500.0) as driver:
        assert emulator.page.rate_hz == 500
        assert driver.describe()["rate_hz"] == 500.0


def test_a_refused_rate_is_a_config_error(host: str) -> None:
    with emulated(host, Page(rate_hz=200)) as emulator:
        emulator.rates_are_fixed = True
        with pytest.raises(ConfigError, match="asked 1000 Hz, got 200 Hz"), opened(host):
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
        emulator.fault = lambda sequence, packet: () if sequence % 10 == 0 else (packet,)
        with opened(host) as driver:
            samples = collect(driver, 200)
            numbers = [sample["seq"] for sample in samples]
            assert not [number for number in numbers if number % 10 == 0]
            lost = sum(b - a - 1 for a, b in itertools.pairwise(numbers))
            assert 0 < lost <= driver.dropped


def test_packets_of_another_length_are_counted_and_left_out(host: str) -> None:
    with emulated(host) as emulator:
        emulator.fault = lambda sequence, packet: (packet, packet[:-1], b"")
        with opened(host) as driver:
            numbers = [sample["seq"] for sample in collect(driver, 50)]
            assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
            assert driver.rejected["corrupt"] >= 98


def test_the_sequence_goes_on_past_two_to_the_32(host: str) -> None:
    start = 2**32 - 20

    def shifted(sequence: int, packet: bytes) -> Iterable[bytes]:
        return (struct.pack(">I", (sequence + start) & 0xFFFFFFFF) + packet[4:],)

    with emulated(host) as emulator:
        emulator.fault = shifted
        with opened(host) as driver:
            numbers = [sample["seq"] for sample in collect(driver, 100)]
            assert numbers == list(range(start + 1, start + 1 + len(numbers)))
            assert driver.dropped == 0


def test_a_sequence_that_begins_anew_is_device_lost(host: str) -> None:
    with emulated(host) as emulator:
        emulator.fault = lambda sequence, packet: (
            (struct.pack(">I", sequence + (5000 if sequence < 50 else 0)) + packet[4:],)
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

    def noted(sequence: int, packet: bytes) -> Iterable[bytes]:
        sent.append(sequence)
        return (packet,)

    with emulated(host) as emulator:
        emulator.fault = noted
        with opened(host) as driver:
            collect(driver, 5)
        # The next stream counts from one again, since the previous one had ended.
        with opened(host) as driver:
            collect(driver, 5)
        assert sent.count(1) == 2


class LateClock(SystemClock):
    """Wakes 5 ms late, as on a machine whose cores are taken."""

    def sleep_until(self, deadline_ns: int) -> None:
        super().sleep_until(deadline_ns + 5_000_000)


def test_records_that_the_machine_is_late_for_are_sent_all_the_same(host: str) -> None:
    config = NetFtEmulatorConfig(host=host)
    with (
        running(FaultyNetFt(config, FixedWorld(wrench=WRENCH), LateClock())),
        opened(host) as driver,
    ):
        samples = collect(driver, 600)
    span = (samples[-1]["t_ns"] - samples[0]["t_ns"]) / 1e9
    # One record each time it wakes would be less than 200 in a second.
    assert 500 < len(samples) / span < 1100


def test_noise_has_the_asked_spread(host: str) -> None:
    with emulated(host, noise=0.1, seed=3), opened(host) as driver:
        values = np.array([sample["value"] for sample in collect(driver, 400)])
        assert values[:, 2].std() == pytest.approx(0.1, rel=0.3)
        assert values[:, 5].std() == pytest.approx(0.0005, rel=0.3)


def test_an_independent_client_reads_the_same_from_the_emulator(host: str) -> None:
    pynetft = pytest.importorskip("pynetft", reason="the oracle client is not installed")
    with emulated(host), pynetft.Client(pynetft.Config(sensor_host=host, http_port=8080)) as client:
        samples = list(itertools.islice(client.samples(timeout=60.0), 50))
        assert samples[-1].force == pytest.approx(WRENCH[:3])
        assert samples[-1].torque == pytest.approx([1e3 * value for value in WRENCH[3:]])
        numbers = [sample.rdt_sequence for sample in samples]
        assert all(a < b for a, b in itertools.pairwise(numbers))


def test_an_independent_client_can_bias_the_emulator(host: str) -> None:
    pynetft = pytest.importorskip("pynetft", reason="the oracle client is not installed")
    with emulated(host), pynetft.Client(pynetft.Config(sensor_host=host, http_port=8080)) as client:
        stream = client.samples(timeout=60.0)
        next(stream)
        client.bias()
        for sample in itertools.islice(stream, 2000):
            if sample.force == pytest.approx((0.0, 0.0, 0.0)):
                return
        raise AssertionError("not biased after 2000 samples")


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
