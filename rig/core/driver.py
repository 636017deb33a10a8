"""Interface of the device drivers, and the queue between a reader thread and `read`.

A dedicated thread receives each device's stream, so that every sample is timestamped on arrival
and a slow consumer never gets old data with a new timestamp.
"""

import logging
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import DeviceLost

logger = logging.getLogger(__name__)


class Driver(Protocol):
    """A device of the bench, as used by the process that records its stream."""

    @property
    def dropped(self) -> int:
        """Samples sent by the device, by its sequence numbers, that never reached `read`."""

    @property
    def rejected(self) -> dict[str, int]:
        """Samples left out so far, by reason: `repeated`, `late`, `corrupt`."""

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


class Inbox:
    """Queue of samples from the receiving thread to the caller of `Driver.read`."""

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

    def is_empty(self) -> bool:
        """Return True if no sample is queued."""
        return not self._samples

    def take(self, timeout: float) -> list[dict[str, Any]]:
        """Return all queued samples, waiting up to `timeout` [s] for the first."""
        with self._changed:
            if not self._samples and self._failure is None:
                self._changed.wait(timeout)
            samples = list(self._samples)
            self._samples.clear()
            if not samples and self._failure is not None:
                raise DeviceLost(self._failure)
            return samples


# This many corrupt samples in a row are not of this device, or its line is damaged.
CORRUPT_IN_A_ROW = 10


class ReceivingDriver:
    """Base of the drivers whose samples a thread receives, at most `capacity` for a late consumer.

    A driver defines `_connect`, `_receive`, `_release` and `describe`. In case of silence or damage
    `_receive` calls `_count_wait` or `_count_corrupt`, which raise once there is too much of it.
    `where` is the device's address, for errors; `rejects` are the reasons for which it leaves
    samples out.
    """

    def __init__(
        self, where: str, clock: Clock, capacity: int, rejects: Sequence[str] = ()
    ) -> None:
        self.rejected = dict.fromkeys(rejects, 0)
        """Samples left out so far, by reason."""
        self._where = where
        self._clock = clock
        self._capacity = capacity
        self._gaps = 0
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._begin(0.0)

    def _begin(self, timeout: float) -> None:
        self._inbox = Inbox(self._clock, self._capacity)
        self._deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        self._waits = self._corrupt_in_a_row = 0

    @property
    def dropped(self) -> int:
        """Samples that are known to be lost on the way, or were not read in time."""
        return self._gaps + self._inbox.overflowed

    def open(self, timeout: float) -> None:
        """Connect and receive from now on; see `Driver.open`."""
        self.close()
        self._begin(timeout)
        self._stopping.clear()
        try:
            self._connect(timeout)
        except BaseException:
            self.close()
            raise
        self._thread = threading.Thread(target=self._run, name=self._where, daemon=True)
        self._thread.start()

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Return the samples since the last call; see `Driver.read`."""
        if self._thread is None:
            raise self._not_open()
        return self._inbox.take(timeout)

    def close(self) -> None:
        """Stop the stream and release the device; may be called twice."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._release()

    def _connect(self, timeout: float) -> None:
        """Connect until `_deadline_ns`, `timeout` [s] from now, and apply the settings.

        What is open after an error is released.
        """
        raise NotImplementedError

    def _receive(self) -> None:
        """Put the samples into the inbox that arrive within a fraction of a second."""
        raise NotImplementedError

    def _release(self) -> None:
        """Release the device; may be called twice."""
        raise NotImplementedError

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                self._receive()
        except DeviceLost as error:
            self._inbox.fail(str(error))
        except Exception as error:
            if not self._stopping.is_set():
                logger.exception("%s: receiving failed", self._where)
            self._inbox.fail(f"{self._where}: receiving failed: {error!r}")

    def _left(self) -> float:
        """Return the time that is left to connect [s], at least a little."""
        return max((self._deadline_ns - self._clock.now_ns()) / SECOND_NS, 0.01)

    def _receive_first(self, problem: str) -> None:
        """Receive until a sample is in the inbox; raise `problem` if none is by the deadline."""
        while self._inbox.is_empty():
            if self._clock.now_ns() >= self._deadline_ns:
                raise DeviceLost(f"{self._where}: {problem}")
            self._receive()

    def _count_wait(self, seconds: float, silence: float, problem: str) -> None:
        """Count a wait of `seconds` without data, to be raised as lost from `silence` [s] on.

        Waits are counted, not timed: after a suspension of this process, what waits in the socket
        is received before anything counts as silence. What arrives sets `_waits` to 0.
        """
        self._waits += 1
        if self._waits * seconds >= silence:
            raise DeviceLost(f"{self._where}: {problem}") from None

    def _count_corrupt(self, problem: str, most: int = CORRUPT_IN_A_ROW) -> None:
        """Count a corrupt sample, to be raised as lost if it is the last of `most` in a row.

        A good sample sets `_corrupt_in_a_row` to 0.
        """
        self.rejected["corrupt"] += 1
        self._corrupt_in_a_row += 1
        if self._corrupt_in_a_row >= most:
            raise DeviceLost(f"{self._where}: {problem}") from None

    def _not_open(self) -> DeviceLost:
        return DeviceLost(f"{self._where}: not open")
