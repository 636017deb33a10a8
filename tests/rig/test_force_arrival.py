"""The kernel's arrival time, converted to the monotonic clock."""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Iterator

import pytest

from rig.core.clock import SECOND_NS, FakeClock, SystemClock
from rig.devices.force.netft import StampedSocket


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
    clock = SystemClock()
    stamped = StampedSocket(receiver, clock)
    # The kernel starts to stamp packets shortly after the request.
    threading.Event().wait(0.2)
    bounds = [clock.now_ns()]
    for k in range(3):
        sender.send(bytes([k]))
        threading.Event().wait(0.02)
        bounds.append(clock.now_ns())
    for k, (before_ns, after_ns) in enumerate(itertools.pairwise(bounds)):
        packet, t_ns = stamped.receive(64)
        assert packet == bytes([k])
        # 5 ms tolerance for the step between readings of two clocks.
        assert before_ns - 5_000_000 <= t_ns <= after_ns + 5_000_000


def test_a_clock_that_is_not_the_systems_stamps_with_its_own_time(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    receiver, sender = pair
    clock = FakeClock(7 * SECOND_NS)
    stamped = StampedSocket(receiver, clock)
    sender.send(b"packet")
    assert stamped.receive(64) == (b"packet", clock.now_ns())


def test_a_time_out_is_the_sockets_own(pair: tuple[socket.socket, socket.socket]) -> None:
    receiver, _ = pair
    receiver.settimeout(0.01)
    with pytest.raises(TimeoutError):
        StampedSocket(receiver, SystemClock()).receive(64)
