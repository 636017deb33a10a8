"""What every device driver of the rig can do, and the hand-over from its reader thread to `read`.

A device that streams is received by a thread that does nothing else, so that each sample is
stamped when it arrives and a slow consumer never gets old data under a new time.
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
    """One device of the bench, seen by the process that records its stream."""

    @property
    def dropped(self) -> int:
        """Samples the device sent, by its own sequence numbers, that never reached `read`."""

    def open(self, timeout: float) -> None:
        """Reach the device within `timeout` [s], check and apply its settings, start the stream.

        Raises:
            DeviceLost: Nothing answers at the address, or not as the device would.
            ConfigError: The device refuses a setting.
        """

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """All samples that arrived since the last call, waiting up to `timeout` [s] for one.

        Each is a dict of the stream's columns, `t_ns` (host monotonic arrival) among them; times
        strictly increase. Empty when nothing arrived in time.

        Raises:
            DeviceLost: The device is gone or silent; samples received before come out first.
        """

    def describe(self) -> dict[str, Any]:
        """Facts read from the opened device, ready for JSON: model, units, rates it states."""

    def close(self) -> None:
        """Stop the stream and let go of the device; safe twice."""


@runtime_checkable
class Sorting(Protocol):
    """A driver that leaves out what no stream may hold twice, out of order, or spoilt."""

    @property
    def refused(self) -> dict[str, int]:
        """What came and was left out since `open`, by reason: repeated, late, spoilt."""


def refused(driver: Driver) -> dict[str, int]:
    """What `driver` left out, by reason; empty for one that does not say."""
    return driver.refused if isinstance(driver, Sorting) else {}


class Inbox:
    """Samples on their way from the thread that receives them to the caller of `Driver.read`.

    Args:
        clock: Stamps what is put without a time.
        capacity: Samples kept for a consumer that is late; what comes then is counted and lost.
    """

    def __init__(self, clock: Clock, capacity: int) -> None:
        self._clock = clock
        self._capacity = capacity
        self._samples: deque[dict[str, Any]] = deque()
        self._changed = threading.Condition()
        self._failure: str | None = None
        self._newest_ns = -1
        self.overflowed = 0
        """Samples lost because nobody took them in time."""

    def put(self, sample: dict[str, Any], t_ns: int | None = None) -> None:
        """Add a sample that arrived at `t_ns`, or now; equal times are moved apart by 1 ns."""
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
        """End the stream: `take` raises DeviceLost with `reason` once it is empty."""
        with self._changed:
            self._failure = self._failure or reason
            self._changed.notify()

    def take(self, timeout: float) -> list[dict[str, Any]]:
        """Everything that arrived, waiting up to `timeout` [s] for the first.

        Raises:
            DeviceLost: The stream has ended and everything received was taken.
        """
        with self._changed:
            if not self._samples and self._failure is None:
                self._changed.wait(timeout)
            taken = list(self._samples)
            self._samples.clear()
            if not taken and self._failure is not None:
                raise DeviceLost(self._failure)
            return taken


class Receiver:
    """The thread of one open stream: calls `receive` until it is closed or the device is lost.

    Args:
        name: Thread name.
        receive: Blocks for at most a fraction of a second, puts what came into the inbox.
        inbox: Where DeviceLost raised by `receive` ends up.
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
        """Stop after the call in progress and wait for it; safe twice."""
        self._stopping.set()
        self._thread.join()
