"""Interface of the device drivers, and the queue between a reader thread and `read`.

A dedicated thread receives each device's stream, so that every sample is timestamped on arrival
and a slow consumer never gets old data with a new timestamp.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from rig.core.clock import Clock
from rig.core.errors import DeviceLost

logger = logging.getLogger(__name__)


class Driver(Protocol):
    """A device of the bench, as used by the process that records its stream."""

    @property
    def dropped(self) -> int:
        """Samples sent by the device, by its sequence numbers, that never reached `read`."""

    def open(self, timeout: float) -> None:
        """Connect within `timeout` [s], check and apply the settings, and start the stream.

        Raises:
            DeviceLost: Nothing answers at the address, or the answer is not this device's.
            ConfigError: The device rejects a setting.
        """

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Return the samples since the last call, waiting up to `timeout` [s] for the first.

        Each is a dict of the stream's columns, including `t_ns` (monotonic arrival at the host).
        Times increase strictly. The list is empty if nothing arrived in time.

        Raises:
            DeviceLost: The device is gone or silent; samples already received are returned first.
        """

    def describe(self) -> dict[str, Any]:
        """Return properties of the open device, JSON-serialisable: model, units, stated rates."""

    def close(self) -> None:
        """Stop the stream and release the device; may be called twice."""


@runtime_checkable
class Sorting(Protocol):
    """Driver that leaves out samples that are repeated, out of order or corrupt."""

    @property
    def rejected(self) -> dict[str, int]:
        """Number of samples left out since `open`, by reason: `repeated`, `late`, `corrupt`."""


def rejected(driver: Driver) -> dict[str, int]:
    """Return the counts of samples `driver` left out, by reason; empty if it keeps none."""
    return driver.rejected if isinstance(driver, Sorting) else {}


class Inbox:
    """Queue of samples from the receiving thread to the caller of `Driver.read`.

    Args:
        clock: Timestamps the samples put without a time.
        capacity: Samples kept for a late consumer; further samples are counted and discarded.
    """

    def __init__(self, clock: Clock, capacity: int) -> None:
        self._clock = clock
        self._capacity = capacity
        self._samples: deque[dict[str, Any]] = deque()
        self._changed = threading.Condition()
        self._failure: str | None = None
        self._newest_ns = -1
        self.overflowed = 0
        """Samples discarded because the queue was full."""

    def put(self, sample: dict[str, Any], t_ns: int | None = None) -> None:
        """Add a sample that arrived at `t_ns` (default: now); equal times are separated by 1 ns."""
        if t_ns is None:
            t_ns = self._clock.now_ns()
        with self._changed:
            self._newest_ns = sample["t_ns"] = max(t_ns, self._newest_ns + 1)
            if len(self._samples) >= self._capacity:
                self.overflowed += 1
                return
            self._samples.append(sample)
            self._changed.notify()

    def fail(self, reason: str) -> None:
        """End the stream: `take` raises DeviceLost with `reason` once the queue is empty."""
        with self._changed:
            self._failure = self._failure or reason
            self._changed.notify()

    def take(self, timeout: float) -> list[dict[str, Any]]:
        """Return all queued samples, waiting up to `timeout` [s] for the first."""
        with self._changed:
            if not self._samples and self._failure is None:
                self._changed.wait(timeout)
            taken = list(self._samples)
            self._samples.clear()
            if not taken and self._failure is not None:
                raise DeviceLost(self._failure)
            return taken


class Receiver:
    """Thread of an open stream: calls `receive` until it is closed or the device is lost.

    Args:
        name: Thread name.
        receive: Blocks for at most a fraction of a second and puts received samples into the inbox.
        inbox: Inbox that fails with a DeviceLost raised by `receive`.
    """

    def __init__(self, name: str, receive: Callable[[], None], inbox: Inbox) -> None:
        self._receive = receive
        self._inbox = inbox
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                self._receive()
        except DeviceLost as error:
            self._inbox.fail(str(error))
        except Exception as error:
            if not self._stopping.is_set():
                logger.exception("%s: receiving failed", self._thread.name)
            self._inbox.fail(f"{self._thread.name}: receiving failed: {error!r}")

    def close(self) -> None:
        """Stop after the current call and wait for the thread; may be called twice."""
        self._stopping.set()
        self._thread.join()


class ReceivingDriver:
    """Base of the drivers whose samples a thread receives.

    Args:
        where: Address of the device, for errors.
        clock: Timestamps the samples.
        capacity: Samples kept for a late consumer.
    """

    def __init__(self, where: str, clock: Clock, capacity: int) -> None:
        self._where = where
        self._clock = clock
        self._capacity = capacity
        self._inbox = Inbox(clock, capacity)
        self._receiver: Receiver | None = None
        self._gaps = 0

    @property
    def dropped(self) -> int:
        """Samples that are known to be lost on the way, or were not read in time."""
        return self._gaps + self._inbox.overflowed

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Return the samples since the last call; see `Driver.read`."""
        if self._receiver is None:
            raise self._not_open()
        return self._inbox.take(timeout)

    def close(self) -> None:
        """Stop the stream and release the device; may be called twice."""
        if self._receiver is not None:
            self._receiver.close()
            self._receiver = None
        self._release()

    def _receive(self) -> None:
        """Put the samples into the inbox that arrive within a fraction of a second."""
        raise NotImplementedError

    def _release(self) -> None:
        """Release the device; may be called twice."""
        raise NotImplementedError

    def _reset(self) -> None:
        """Close the device if it is open, and begin with an empty inbox."""
        self.close()
        self._inbox = Inbox(self._clock, self._capacity)

    def _start_receiving(self, name: str) -> None:
        self._receiver = Receiver(name, self._receive, self._inbox)

    def _not_open(self) -> DeviceLost:
        return DeviceLost(f"{self._where}: not open")
