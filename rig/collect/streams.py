"""All streams of a session together: start, measure, record, end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rig.bench import Bench
from rig.clock import SECOND_NS, Clock
from rig.errors import DeviceLost
from rig.streams.handle import StreamHandle
from rig.streams.kinds import expected_rate, stream_names

SILENT = 2.0
# A signal (camera, taxels) that shows no new sample for so long is lost; force and pose have their
# own, shorter limits in the guard [s].
SLOW_FRACTION, SLOW = 0.5, 3.0
# A stream that comes at less than this part of its rate (what the preflight refuses too) for so
# long [s] is no recording of what happens.


class Streams:
    """The streams of one bench, as a context manager.

    Args:
        bench: The bench, with addresses filled in.
        folder: Run folder for shared records.
        clock: Clock.
        watch: Raises when what is behind the devices is gone, as a mock bench's World.
    """

    def __init__(
        self, bench: Bench, folder: Path, clock: Clock, watch: Callable[[], None] | None = None
    ) -> None:
        self._clock = clock
        self._watch = watch
        self._handles = {name: StreamHandle(name, bench, folder) for name in stream_names(bench)}
        self._summaries: dict[str, Any] = {}
        self._closed = False
        self._expected = {name: expected_rate(bench, name) for name in self._handles}
        self._slow_since_ns: dict[str, int] = {}

    def __enter__(self) -> Streams:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[StreamHandle]:
        return iter(self._handles.values())

    def __getitem__(self, name: str) -> StreamHandle:
        return self._handles[name]

    def __contains__(self, name: str) -> bool:
        return name in self._handles

    def wait_opened(self) -> dict[str, dict[str, Any]]:
        """Facts of every device, by stream.

        Raises:
            ConfigError, DeviceLost: What the first driver to fail found.
        """
        return {handle.name: handle.wait_opened() for handle in self}

    def measure(self, seconds: float, *names: str) -> dict[str, dict[str, Any]]:
        """Rate, mean and spread over the same window of the named streams (all when none)."""
        chosen = [handle for handle in self if not names or handle.name in names]
        for handle in chosen:
            handle.start_measuring(seconds)
        return {handle.name: handle.measured(seconds) for handle in chosen}

    def check(self) -> None:
        """Notice a stream that failed, or a signal that went silent.

        Raises:
            ConfigError, DeviceLost, SessionError: What ended it.
        """
        now_ns = self._clock.now_ns()
        # The streams first: of a device that is gone, its driver knows more than its process.
        for handle in self:
            handle.check()
            latest = handle.latest()
            if latest is not None and now_ns - int(latest["t_ns"]) > SILENT * SECOND_NS:
                raise DeviceLost(
                    f"{handle.name}: no sample for {(now_ns - int(latest['t_ns'])) / SECOND_NS:.1f}"
                    f" s; allowed: {SILENT:.1f} s; is the device powered and connected?"
                )
            self._check_rate(handle, now_ns)
        if self._watch is not None:
            self._watch()

    def _check_rate(self, handle: StreamHandle, now_ns: int) -> None:
        counters = handle.counters()
        expected = self._expected[handle.name]
        if counters is None or counters["rate_hz"] >= SLOW_FRACTION * expected:
            self._slow_since_ns.pop(handle.name, None)
            return
        since_ns = self._slow_since_ns.setdefault(handle.name, now_ns)
        if now_ns - since_ns > SLOW * SECOND_NS:
            raise DeviceLost(
                f"{handle.name}: {counters['rate_hz']:.0f} Hz for {SLOW:.0f} s; expected "
                f"{expected:.0f} Hz; is its line overloaded, or its lighting too dim?"
            )

    def counters(self) -> dict[str, np.void]:
        """COUNTERS of every stream that has shown some."""
        found = {handle.name: handle.counters() for handle in self}
        return {name: counters for name, counters in found.items() if counters is not None}

    def close(self) -> dict[str, Any]:
        """Seal and end every stream; their summaries by name. Safe twice."""
        if not self._closed:
            self._closed = True
            for handle in self:
                summary = handle.close()
                if summary is not None:
                    self._summaries[handle.name] = summary
        return self._summaries
