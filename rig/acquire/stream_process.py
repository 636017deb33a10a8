"""Process of one stream: appends the driver's samples directly to the shard log.

It receives commands through a pipe and answers there. Its newest sample and its counters are
readable in shared memory. When the pipe closes, the parent is gone; the process then seals its
data and ends.
"""

from __future__ import annotations

import logging
import signal
from collections import deque
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from recorder.errors import SessionError
from recorder.session import StreamWriter
from rig.bench.bench import AVERAGED, StreamBench
from rig.core.clock import SECOND_NS, Clock, SystemClock
from rig.core.driver import Driver
from rig.core.errors import ConfigError, DeviceLost
from rig.core.load import Stalls
from rig.core.realtime import Sweeper, enable_realtime
from rig.core.samples import SIGNAL_LATEST
from rig.core.shared_memory import SharedLatest

if TYPE_CHECKING:
    from rig.acquire.signal_level import SignalLevel

logger = logging.getLogger(__name__)

# Last arrival [ns], samples since opening, rows stored by this run, samples sent by the device but
# not received, rate over the last second [Hz], longest gap between stored samples [s].
# `stalled`: longest time for which the process stood still in the last 10 s [s].
COUNTERS = np.dtype(
    [
        ("t_ns", "<i8"),
        ("samples", "<i8"),
        ("rows", "<i8"),
        ("dropped", "<i8"),
        ("rate_hz", "<f8"),
        ("longest_gap", "<f8"),
        ("stalled", "<f8"),
    ]
)

# Longest delay of a command from the parent while the device is silent [s].
_READ_TIMEOUT = 0.05
_COUNTERS_EVERY_NS = SECOND_NS // 20


class _Measurement:
    """Samples of a time window: rate, mean, spread."""

    def __init__(self, averaged: bool, start_ns: int, seconds: float) -> None:
        self._averaged = averaged
        self._start_ns = start_ns
        self.end_ns = start_ns + round(seconds * SECOND_NS)
        self._times: list[int] = []
        self._values: list[Any] = []

    def add(self, sample: dict[str, Any]) -> None:
        if self._start_ns <= sample["t_ns"] <= self.end_ns:
            self._times.append(sample["t_ns"])
            if self._averaged and sample.get("settled", True):
                self._values.append(sample["value"])

    def result(self) -> dict[str, Any]:
        """Return `n`, `rate_hz`, `longest_gap` [s]; if averaged, `mean` and `std` of the values."""
        times = np.array([self._start_ns, *self._times, self.end_ns], dtype=np.int64)
        inner = times[1:-1]
        span = (inner[-1] - inner[0]) / SECOND_NS if len(inner) > 1 else 0.0
        summary: dict[str, Any] = {
            "n": len(inner),
            "t_ns": int(self.end_ns),
            "rate_hz": (len(inner) - 1) / span if span > 0 else 0.0,
            "longest_gap": float(np.diff(times).max()) / SECOND_NS,
        }
        if self._averaged and self._values:
            values = np.array(self._values, dtype=float)
            summary |= {"mean": values.mean(axis=0), "std": values.std(axis=0)}
        return summary


class _StreamLoop:
    """State of the running process of a stream, with shared records in `folder`."""

    def __init__(
        self,
        name: str,
        bench: StreamBench,
        folder: Path,
        pipe: Connection,
        driver: Driver,
        clock: Clock,
    ) -> None:
        row = bench.row(name)
        self._averaged = row.kind in AVERAGED
        self._pipe = pipe
        self._driver = driver
        self._clock = clock
        self._latest = SharedLatest.attach(folder / f"{name}.latest", row.latest, writable=True)
        self._counters = SharedLatest.attach(folder / f"{name}.counters", COUNTERS, writable=True)
        self._fields = row.latest.names or ()
        self._level: SignalLevel | None = None
        signal = bench.signal
        if bench.no_gauge and signal is not None and signal.name == name:
            from rig.acquire.signal_level import SignalLevel

            self._level = SignalLevel(is_image=signal.kind == "camera")
            path = folder / f"{name}.signal"
            self._signal = SharedLatest.attach(path, SIGNAL_LATEST, writable=True)
        self._fresh_ns = self._moved_ns = 0
        self._zero: np.ndarray | None = None
        self._sweeper = Sweeper()
        self._stalls = Stalls(_READ_TIMEOUT)
        self._writer: StreamWriter | None = None
        self._columns: tuple[str, ...] = ()
        self._bias: np.ndarray | None = None
        self._measurement: _Measurement | None = None
        self._recent: deque[int] = deque()
        self._samples = self._rows = 0
        self._dropped_before = 0
        self._rejected_before: dict[str, int] = {}
        self._last_ns = self._shown_ns = 0
        self._longest_gap = 0.0

    def run(self) -> None:
        """Run until a close command, or until the parent's end of the pipe is gone."""
        while True:
            while self._pipe.poll():
                command, argument = self._pipe.recv()
                if command == "close":
                    self._pipe.send(("closed", self.close()))
                    return
                getattr(self, f"_on_{command}")(argument)
            for sample in self._driver.read(_READ_TIMEOUT):
                self._take(sample)
            now_ns = self._clock.now_ns()
            self._stalls.turn(now_ns)
            if now_ns - self._shown_ns >= _COUNTERS_EVERY_NS:
                self._show(now_ns)
            if self._measurement is not None and now_ns > self._measurement.end_ns:
                self._pipe.send(("measured", self._measurement.result()))
                self._measurement = None

    def _on_measure(self, seconds: float) -> None:
        self._measurement = _Measurement(self._averaged, self._clock.now_ns(), seconds)

    def _on_bias(self, bias: list[float]) -> None:
        self._bias = np.array(bias)
        self._pipe.send(("biased", None))

    def _on_zero(self, value: list[float] | None) -> None:
        """Take the present samples, or `value`, as those without contact, for the guards."""
        if self._level is not None:
            self._level.zero()
        if value is not None:
            self._zero = np.array(value)
        self._pipe.send(("zeroed", None))

    def _on_command(self, arguments: tuple[Any, ...]) -> None:
        commanded: Any = self._driver
        commanded.command(*arguments)
        self._pipe.send(("commanded", None))

    def _on_record(self, path: Path) -> None:
        self._writer = StreamWriter.open(path)
        self._columns = self._writer.columns
        self._rows, self._longest_gap, self._last_ns = 0, 0.0, 0
        self._stalls = Stalls(_READ_TIMEOUT)
        self._dropped_before = self._driver.dropped
        self._rejected_before = dict(self._driver.rejected)
        self._pipe.send(("recording", None))

    def _take(self, sample: dict[str, Any]) -> None:
        if self._bias is not None:
            sample["value"] = sample["value"] - self._bias
        row = -1
        if self._writer is not None:
            row = self._writer.append(**{name: sample[name] for name in self._columns})
            self._rows += 1
            if self._last_ns:
                gap = (sample["t_ns"] - self._last_ns) / SECOND_NS
                self._longest_gap = max(self._longest_gap, gap)
        # The zero is for the guards alone: what is stored and averaged is as the device sent it.
        guarded = {"status": 0, **sample, "row": row}
        if self._zero is not None:
            guarded["value"] = sample["value"] - self._zero
        self._latest.write(tuple(guarded[name] for name in self._fields))
        if self._level is not None:
            level = self._level.add(sample)
            t_ns = sample["t_ns"]
            self._fresh_ns = t_ns if level.fresh else self._fresh_ns
            self._moved_ns = t_ns if level.moved else self._moved_ns
            times = t_ns, self._fresh_ns, self._moved_ns
            self._signal.write((*times, level.change, level.motion))
        self._last_ns = sample["t_ns"]
        self._samples += 1
        self._recent.append(sample["t_ns"])
        if self._measurement is not None:
            self._measurement.add(sample)

    def _show(self, now_ns: int) -> None:
        while self._recent and self._recent[0] < now_ns - SECOND_NS:
            self._recent.popleft()
        dropped = self._driver.dropped - self._dropped_before
        rate_hz = float(len(self._recent))
        stalled = self._stalls.longest(now_ns - 10 * SECOND_NS)
        self._counters.write(
            (self._last_ns, self._samples, self._rows, dropped, rate_hz, self._longest_gap, stalled)
        )
        self._shown_ns = now_ns
        self._sweeper.sweep(now_ns)

    def close(self) -> dict[str, Any]:
        """Seal the recorded data and return its summary."""
        self._show(self._clock.now_ns())
        summary = {
            "rows": self._rows,
            "dropped": self._driver.dropped - self._dropped_before,
            "refused": {
                reason: count - self._rejected_before.get(reason, 0)
                for reason, count in self._driver.rejected.items()
            },
            "longest_gap": self._longest_gap,
            "stalls": self._stalls.found,
        }
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.close()
        return summary


def run_stream(name: str, bench: StreamBench, folder: Path, pipe: Connection) -> None:
    """Run the process of a stream of a bench with addresses; `pipe` is its end."""
    # Ctrl-C and a closed terminal are handled by the parent, which closes all streams in order.
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    granted = enable_realtime()
    clock = SystemClock()
    loop: _StreamLoop | None = None
    driver: Driver | None = None
    try:
        driver = bench.row(name).driver(clock)
        driver.open(bench.preflight.timeout)
        loop = _StreamLoop(name, bench, folder, pipe, driver, clock)
        pipe.send(("opened", {**driver.describe(), "granted": granted}))
        loop.run()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        logger.warning("%s: the collecting process is gone; sealing and ending", name)
    except (ConfigError, DeviceLost, SessionError, OSError) as error:
        _report(pipe, name, error)
    finally:
        if loop is not None:
            try:
                loop.close()
            except (SessionError, OSError) as error:
                _report(pipe, name, error)
        if driver is not None:
            driver.close()
        pipe.close()


def _report(pipe: Connection, name: str, error: Exception) -> None:
    kind = type(error).__name__ if isinstance(error, ConfigError | DeviceLost) else "SessionError"
    try:
        pipe.send(("failed", (kind, f"{name}: {error}")))
    except OSError:
        logger.warning("%s: %s (the parent process is gone)", name, error)
