"""All streams of a session: start, check before recording, measure, record, end."""

import logging
import math
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.command_line.options import next_command
from recorder.errors import SessionError
from rig.acquire.control import Interlocks
from rig.acquire.stream_process import COUNTERS, run_stream
from rig.bench.bench import Bench, BenchStream, StreamBench
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost, SafetyStop, all_opened
from rig.core.samples import SIGNAL_LATEST
from rig.core.shared_memory import SLOTS, SharedLatest
from trajectories import Point

_ERRORS = {error.__name__: error for error in (ConfigError, DeviceLost, SessionError)}
# Starting an interpreter and importing OpenCV takes a second here, more on a busy machine and when
# many start at once: the time allowed in all, and for each stream [s].
_START_TIMEOUT, _START_TIMEOUT_EACH = 60.0, 6.0
# Sealing syncs up to 64 images; a slow disk may need the time, and killing it would lose the seal.
_CLOSE_TIMEOUT = 30.0


class StreamHandle:
    """Starts, queries and ends the process of one stream, with shared records in `folder`."""

    def __init__(self, name: str, bench: StreamBench, folder: Path) -> None:
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
        arguments = (name, bench, folder, theirs)
        self._process = context.Process(
            target=run_stream, args=arguments, name=f"stream-{name}", daemon=False
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
        result: dict[str, Any] = self._answer("measured", seconds)
        return result

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

    def command(self, *arguments: Any) -> None:
        """Send a command to the device; see `command` of its driver."""
        self._send("command", arguments)
        self._answer("commanded", 1.0)

    def record(self, path: Path) -> None:
        """Append to the stream group at `path` from now on."""
        self._send("record", path)
        self._answer("recording", 5.0)

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
                self._fail(
                    DeviceLost(
                        f"{self.name}: its process does not answer ('{word}'); does it hang?"
                    )
                )
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

    `watch` raises if a backend of the devices is gone, such as a mock bench's World; `start` starts
    the stream of a name.
    """

    def __init__(
        self,
        bench: StreamBench,
        folder: Path,
        clock: Clock,
        watch: Callable[[], None] | None = None,
        start: Callable[[str, Any, Path], StreamHandle] = StreamHandle,
    ) -> None:
        self.bench: Any = bench
        self.clock = clock
        self._watch = watch
        self._handles = {row.name: start(row.name, bench, folder) for row in bench.rows}
        self._gauges = [row.name for row in bench.of_kind("force")]
        self._summaries: dict[str, Any] = {}
        self._closed = False
        self._expected = {row.name: row.rate_hz for row in bench.rows}
        self._slow_since_ns: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[StreamHandle]:
        return iter(self._handles.values())

    def __getitem__(self, name: str) -> StreamHandle:
        return self._handles[name]

    def wait_opened(self) -> dict[str, dict[str, Any]]:
        """Wait until all drivers are open and return the properties of their devices by stream."""
        return all_opened({handle.name: handle.wait_opened for handle in self})

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
        published = {handle.name: handle.counters() for handle in self}
        return {name: counters for name, counters in published.items() if counters is not None}

    def stalled(self) -> float:
        """Return the longest time for which a stream's process stood still lately [s]."""
        return max((float(each["stalled"]) for each in self.counters().values()), default=0.0)

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


# Checks before recording: every device answers at its rate, the tip is clear; the tare.


logger = logging.getLogger(__name__)

# Least number of periods of the slowest stream over which rates are measured.
_PERIODS = 4
_AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


def check_devices(
    streams: Streams, interlocks: Interlocks | None = None
) -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """Open every device; return `Driver.describe()` and the measured rate [Hz] of each."""
    bench = streams.bench
    opens = {"streams": streams.wait_opened}
    if interlocks is not None:
        opens["interlocks"] = interlocks.open
    # All are tried, so that a bench with nothing attached is one message and not one per start.
    description = {name: each for part in all_opened(opens).values() for name, each in part.items()}
    rates: dict[str, float] = {}
    window = rate_window(bench, min(row.rate_hz for row in bench.rows))
    for name, measured in streams.measure(window).items():
        rate, expected = measured["rate_hz"], bench.row(name).rate_hz
        rates[name] = rate
        deviation = rate / expected - 1
        logger.info(
            "preflight  %-7s %7.1f Hz (expected %.0f)  longest gap %.1f ms",
            name,
            rate,
            expected,
            1e3 * measured["longest_gap"],
        )
        if rate < 0.5 * expected:
            raise DeviceLost(
                f"{name}: {rate:.1f} Hz measured; expected {expected:.0f} Hz (bench "
                "file); is its connection overloaded?"
            )
        if abs(deviation) > bench.preflight.rate_tolerance:
            logger.warning("preflight  %s is %+.0f %% off its expected rate", name, 100 * deviation)
    return description, rates


def rate_window(bench: Bench, rate_hz: float) -> float:
    """Return the time in which to measure the rate of a stream that states `rate_hz` [s]."""
    return max(bench.preflight.rate_window, _PERIODS / rate_hz)


def notes_on(
    description: Mapping[str, Mapping[str, Any]], signals: Sequence[str], calibrated: Sequence[str]
) -> list[str]:
    """Return what the recording will not tell: latencies not measured, and drops not seen."""
    notes = [
        f"{name} latency not calibrated ({next_command('calibrate-latency')})"
        for name in signals
        if name in description and name not in calibrated
    ]
    for name, device in description.items():
        if device.get("numbering", "device") != "device":
            notes.append(f"{name}: drops are only inferred: the device numbers no samples")
    return notes


def tip_position(streams: Streams) -> Point:
    """Return the position of the tip in the contact frame [m]."""
    latest = streams["pose"].latest()
    if latest is None:
        raise DeviceLost("pose: no sample yet")
    bench: Bench = streams.bench
    return bench.tip(latest["value"])


def check_clear(streams: Streams) -> None:
    """Reject a tip at or below the surface, or outside the box."""
    x, y, z = tip_position(streams)
    limits = streams.bench.limits
    inside = (
        limits.box_x[0] <= x <= limits.box_x[1]
        and limits.box_y[0] <= y <= limits.box_y[1]
        and z <= limits.height_max
    )
    position_text = (
        f"the tip is at x {1e3 * x:.1f}, y {1e3 * y:.1f}, z {1e3 * z:.1f} mm of the sensor"
    )
    if z <= 0:
        raise SafetyStop(
            f"{position_text}: at or below its surface; jog it clear, then start again"
        )
    if not inside:
        raise SafetyStop(f"{position_text}: outside the bench's box; jog it above the sensor")


def take_tares(streams: Streams) -> dict[str, dict[str, Any]]:
    """Return `mean` and `std` (6,) [N, N m] of every F/T sensor, none of which may be touched."""
    bench = streams.bench
    gauges = bench.of_kind("force")
    names = [gauge.name for gauge in gauges]
    window = max([bench.preflight.tare_window, *(gauge.settling for gauge in gauges)])
    tares = streams.measure(window, *names) if names else {}
    for gauge in gauges:
        _check_tare(bench, gauge, tares[gauge.name])
    return tares


def no_mean(gauge: BenchStream) -> str:
    """Return why a gauge has no mean, for an error."""
    if gauge.settling:
        return f"no settled reading ({gauge.key}.settle_ms, settle_within_n)"
    return "no sample"


def _check_tare(bench: Bench, gauge: BenchStream, tare: dict[str, Any]) -> None:
    if "mean" not in tare:
        raise DeviceLost(f"{gauge.name}: {no_mean(gauge)} during the tare")
    measured = _measured_axes(gauge)
    _require_numbers(gauge, tare["mean"], "during the tare")
    axis, spread = max(
        ((axis, float(tare["std"][axis])) for axis in measured if axis < 3),
        key=lambda each: each[1],
        default=(0, 0.0),
    )
    if spread > bench.preflight.tare_spread:
        raise DeviceLost(
            f"{gauge.name}: {_AXES[axis]} spreads by {spread:.3f} N during the tare; allowed: "
            f"{bench.preflight.tare_spread:.3f} N; is something moving or touching the sensor?"
        )
    logger.info(
        "preflight  tare  %s%s N, spread %.4f N",
        "" if gauge.name == "force" else f"{gauge.name}  ",
        " ".join(f"{value:+.3f}" for value in tare["mean"][:3]),
        spread,
    )


def check_no_contact(bench: Bench, gauge: BenchStream, force: np.ndarray, point: int) -> None:
    """Reject contact above a point: `force` is a gauge's mean tared wrench (6,) there [N, N m]."""
    _require_numbers(gauge, force, f"above point {point}")
    forces = [axis for axis in _measured_axes(gauge) if axis < 3]
    worst = max(forces, key=lambda axis: abs(force[axis]), default=0)
    if forces and abs(force[worst]) > bench.preflight.contact_free:
        which = f"{gauge.name}: " if len(bench.gauges) > 1 else ""
        raise SafetyStop(
            f"point {point}: {which}{_AXES[worst]} is {force[worst]:+.2f} N before the press; "
            f"allowed: {bench.preflight.contact_free:.2f} N; is the surface where the bench file "
            "says?"
        )


def _measured_axes(gauge: BenchStream) -> list[int]:
    """Return the indices in `_AXES` of the axes that an F/T sensor measures."""
    return [index for index, axis in enumerate(_AXES) if axis in gauge.config.axes_measured]


def _require_numbers(gauge: BenchStream, wrench: np.ndarray, when: str) -> None:
    """Reject a mean wrench (6,) that is NaN or infinite on an axis that the gauge measures."""
    if bad := [_AXES[axis] for axis in _measured_axes(gauge) if not np.isfinite(wrench[axis])]:
        raise DeviceLost(
            f"{gauge.name}: {', '.join(bad)} not a number {when}; is a cable loose? An axis that "
            f"the F/T sensor lacks is left out of the bench file's {gauge.key}.axes_measured"
        )
