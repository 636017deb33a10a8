"""All streams of a session: start, measure, record, end."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from recorder import SessionError
from rig.acquire.stream_process import COUNTERS, StreamJob, run_stream
from rig.bench.bench import Bench
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost, raise_all
from rig.core.samples import SIGNAL_LATEST
from rig.core.shared_memory import SLOTS, SharedLatest

# Side of the collecting process.

_ERRORS = {error.__name__: error for error in (ConfigError, DeviceLost, SessionError)}
# Starting an interpreter and importing OpenCV takes a second here, more on a busy machine and when
# many start at once: the time allowed in all, and for each stream [s].
_START_TIMEOUT, _START_TIMEOUT_EACH = 20.0, 6.0
# Sealing syncs up to 64 images; a slow disk may need the time, and killing it would lose the seal.
_CLOSE_TIMEOUT = 30.0


class StreamHandle:
    """Starts, queries and ends the process of one stream, with shared records in `folder`."""

    def __init__(self, name: str, bench: Bench, folder: Path) -> None:
        self.name = name
        self._bench = bench
        self._patience = max(_START_TIMEOUT, _START_TIMEOUT_EACH * len(bench.rows))
        # The guard of the arm sees every record of the last two seconds.
        slots = max(SLOTS, math.ceil(2 * bench.row(name).rate_hz))
        self._latest = SharedLatest.create(folder / f"{name}.latest", bench.row(name).latest, slots)
        self._counters = SharedLatest.create(folder / f"{name}.counters", COUNTERS)
        signal = bench.signal
        self._signal: SharedLatest | None = None
        if bench.no_gauge and signal is not None and signal.name == name:
            self._signal = SharedLatest.create(folder / f"{name}.signal", SIGNAL_LATEST, slots)
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        job = StreamJob(name, bench, folder)
        self._process = context.Process(
            target=run_stream, args=(job, theirs), name=f"stream-{name}", daemon=False
        )
        self._process.start()
        theirs.close()
        self._closed = False
        self._failure: Exception | None = None

    def wait_opened(self) -> dict[str, Any]:
        """Wait until the driver is open and return the properties of its device."""
        description: dict[str, Any] = self._answer("opened", self._bench.preflight.timeout)
        return description

    def start_measuring(self, seconds: float) -> None:
        """Begin a time window for measuring rate, mean and spread."""
        self._send("measure", seconds)

    def measured(self, seconds: float) -> dict[str, Any]:
        """Return the result of the window of `start_measuring(seconds)`; see `_Measurement`."""
        found: dict[str, Any] = self._answer("measured", seconds)
        return found

    def set_bias(self, bias: np.ndarray) -> None:
        """Subtract `bias` from every value from now on."""
        self._send("bias", [float(value) for value in bias])
        self._answer("biased", 1.0)

    def zero(self, value: np.ndarray | None) -> None:
        """Take the present samples as those without contact, for the guards; none is stored so.

        `value` is the mean without contact of an arm's wrench (6,) [N, N m]; None for a signal.
        """
        self._send("zero", None if value is None else [float(each) for each in value])
        self._answer("zeroed", 1.0)

    def signal(self) -> np.void | None:
        """Return the newest SIGNAL_LATEST; None if the stream guards nothing."""
        return None if self._signal is None else self._signal.read()

    def record(self, path: Path) -> int:
        """Append to the stream group at `path` from now on; return its number of rows."""
        self._send("record", path)
        rows: int = self._answer("recording", 5.0)
        return rows

    def latest(self) -> np.void | None:
        """Return the newest sample as a record of the stream's kind."""
        return self._latest.read()

    def counters(self) -> np.void | None:
        """Return the COUNTERS, updated 20 times per second."""
        return self._counters.read()

    def check(self) -> None:
        """Raise if the stream has failed."""
        if self._failure is not None:
            raise self._failure
        try:
            while self._pipe.poll():
                self._failed_by(self._pipe.recv())
        except (EOFError, OSError):
            self._fail(DeviceLost(f"{self.name}: its process ended (code {self._exit_code()})"))

    def close(self) -> dict[str, Any] | None:
        """Seal and end; return the summary, None if the process is gone. May be called twice."""
        if self._closed:
            return None
        self._closed = True
        summary: dict[str, Any] | None = None
        try:
            self._send("close", None)
            summary = self._answer("closed", _CLOSE_TIMEOUT)
        except (DeviceLost, ConfigError, SessionError):
            # `check` reports the error that ended the stream; closing ignores it.
            summary = None
        self._process.join(_CLOSE_TIMEOUT)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()
        self._latest.close()
        self._counters.close()
        if self._signal is not None:
            self._signal.close()
        return summary

    def _send(self, command: str, argument: Any) -> None:
        try:
            self._pipe.send((command, argument))
            return
        except OSError:
            # Nothing is raised in here: as the context of a stored error, this one would keep the
            # pickling buffer of `send` in a cycle, on which Python 3.12 crashes.
            pass
        self.check()
        self._fail(DeviceLost(f"{self.name}: its process ended (code {self._exit_code()})"))

    def _answer(self, word: str, seconds: float) -> Any:
        if self._failure is not None:
            raise self._failure
        while True:
            if not self._pipe.poll(seconds + self._patience):
                self._fail(DeviceLost(f"{self.name}: its process does not answer ('{word}')"))
            try:
                message = self._pipe.recv()
            except (EOFError, OSError):
                self._fail(DeviceLost(f"{self.name}: its process ended (code {self._exit_code()})"))
            if message[0] == word:
                return message[1]
            self._failed_by(message)

    def _failed_by(self, message: tuple[str, Any]) -> None:
        if message[0] == "failed":
            kind, text = message[1]
            self._fail(_ERRORS[kind](text))

    def _fail(self, error: Exception) -> None:
        self._failure = error
        raise error

    def _exit_code(self) -> int | None:
        self._process.join(1.0)
        return self._process.exitcode


# A signal (camera, taxels) without a new sample for this time [s], and this many periods, is lost;
# force and pose have their own, shorter limits in the guard.
SILENT, SILENT_PERIODS = 2.0, 5
# A stream below this fraction of its rate (also the preflight's limit) for this time [s] is too
# sparse to record the press.
SLOW_FRACTION, SLOW = 0.5, 3.0


class Streams:
    """Context manager of the streams of one bench, with shared records in `folder`.

    `watch` raises if a backend of the devices is gone, such as a mock bench's World.
    """

    def __init__(
        self, bench: Bench, folder: Path, clock: Clock, watch: Callable[[], None] | None = None
    ) -> None:
        self.bench = bench
        self.clock = clock
        self._watch = watch
        self._handles = {row.name: StreamHandle(row.name, bench, folder) for row in bench.rows}
        self._gauges = [row.name for row in bench.of_kind("force")]
        self._summaries: dict[str, Any] = {}
        self._closed = False
        self._expected = {row.name: row.rate_hz for row in bench.rows}
        self._slow_since_ns: dict[str, int] = {}

    def __enter__(self) -> Streams:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[StreamHandle]:
        return iter(self._handles.values())

    def __getitem__(self, name: str) -> StreamHandle:
        return self._handles[name]

    def wait_opened(self) -> dict[str, dict[str, Any]]:
        """Wait until all drivers are open and return the properties of their devices by stream."""
        found: dict[str, dict[str, Any]] = {}
        failures: list[Exception] = []
        for handle in self:
            try:
                found[handle.name] = handle.wait_opened()
            except (ConfigError, DeviceLost, SessionError) as error:
                failures.append(error)
        raise_all(failures)
        return found

    def measure(self, seconds: float, *names: str) -> dict[str, dict[str, Any]]:
        """Measure rate, mean and spread of the named streams (default: all) in one time window."""
        chosen = [handle for handle in self if not names or handle.name in names]
        for handle in chosen:
            handle.start_measuring(seconds)
        return {handle.name: handle.measured(seconds) for handle in chosen}

    def check(self) -> None:
        """Raise if a stream failed or a signal went silent."""
        now_ns = self.clock.now_ns()
        # Stream errors first: the driver of a lost device knows more than `watch`.
        for handle in self:
            handle.check()
            latest = handle.latest()
            limit = max(SILENT, SILENT_PERIODS / self._expected[handle.name])
            if latest is not None and now_ns - int(latest["t_ns"]) > limit * SECOND_NS:
                raise DeviceLost(
                    f"{handle.name}: no sample for {(now_ns - int(latest['t_ns'])) / SECOND_NS:.1f}"
                    f" s; allowed: {limit:.1f} s; is the device powered and connected?"
                )
            self._check_rate(handle, now_ns)
        if self._watch is not None:
            self._watch()

    def _check_rate(self, handle: StreamHandle, now_ns: int) -> None:
        counters = handle.counters()
        expected = self._expected[handle.name]
        # The rate of the last second says nothing of a stream with less than two samples in it.
        if expected < 2 or counters is None or counters["rate_hz"] >= SLOW_FRACTION * expected:
            self._slow_since_ns.pop(handle.name, None)
            return
        since_ns = self._slow_since_ns.setdefault(handle.name, now_ns)
        if now_ns - since_ns > SLOW * SECOND_NS:
            raise DeviceLost(
                f"{handle.name}: {counters['rate_hz']:.0f} Hz for {SLOW:.0f} s; expected "
                f"{expected:.0f} Hz; is its connection overloaded, or its lighting too dim?"
            )

    def counters(self) -> dict[str, np.void]:
        """Return the COUNTERS of every stream that has published some."""
        found = {handle.name: handle.counters() for handle in self}
        return {name: counters for name, counters in found.items() if counters is not None}

    def pressing(self) -> str:
        """Return the newest normal force of every F/T sensor as text; empty without one."""
        texts = []
        for name in self._gauges:
            force = self._handles[name].latest()
            text = "Fz ?" if force is None else f"Fz {float(force['value'][2]):+6.2f} N"
            texts.append(text if len(self._gauges) == 1 else f"{name} {text}")
        return "  ".join(texts)

    def close(self) -> dict[str, Any]:
        """Seal and end every stream; return their summaries by name. May be called twice."""
        if not self._closed:
            self._closed = True
            for handle in self:
                summary = handle.close()
                if summary is not None:
                    self._summaries[handle.name] = summary
        return self._summaries
