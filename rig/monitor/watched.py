"""Sensors to watch live: that of a lab bench, of a mock bench, or of a recorded session."""

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from recorder.errors import SessionError
from recorder.session import Session, linear
from rig.bench.bench import Bench, BenchFile
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.camera.jpeg import frame_stamp
from rig.mock.presser import TouchedMock

Triple = tuple[float, float, float]
Times = np.ndarray
# The first run of a session: later ones were recorded after a stop.
_RUN = 0
# Frames before the session's first reference that are without contact.
_UNTOUCHED = 10
# Kinds of streams that can be watched.
SIGNALS = ("camera", "taxels")
# Most samples of a gauge that are kept: 16 minutes at 1 kHz.
_MOST = 1_000_000


class SensorDriver(Protocol):
    """Open driver of a sensor."""

    @property
    def dropped(self) -> int:
        """Samples that never reached `read`."""

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Return the samples that have arrived since, or wait for one for a time [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """Open sensor."""

    sensor: str
    """Name of the sensor."""
    stream: str
    """Name of its stream."""
    driver: SensorDriver
    """Open driver."""
    no_contact: np.ndarray | None = None
    """Frames known to be without contact; None: the first to arrive must be."""
    start: Callable[[int], None] = lambda start_ns: None
    """Sets when a recorded session is played from [ns], by default from the first `read`."""
    begin: Callable[[], None] = lambda: None
    """Starts the presses of a mock bench; called after the frames without contact."""
    over: Callable[[], bool] = lambda: False
    """Returns True if no more frames will come."""
    check: Callable[[], None] = lambda: None
    """Raises DeviceLost if an emulator has ended."""
    shows_ns: Callable[[dict[str, Any]], int] = lambda sample: int(sample["t_ns"])
    """Returns the time of a sample for `wrench` [ns]."""
    wrench: Callable[[Times], np.ndarray] | None = None
    """Returns the true or measured wrench (n, 6) [N, N m] at times (n,) [ns]; None if unknown."""
    gauge: Callable[[], Triple | None] = lambda: None
    """Returns the newest force of the bench's gauge [N]; None if it has none."""


class GaugeBeside:
    """The gauge of a lab bench, read while forces are predicted; zero is its first second."""

    def __init__(self, driver: SensorDriver) -> None:
        self._driver = driver
        self._bias: np.ndarray | None = None
        self._first: list[np.ndarray] = []
        self._times: deque[int] = deque(maxlen=_MOST)
        self._values: deque[np.ndarray] = deque(maxlen=_MOST)

    def newest(self) -> Triple | None:
        """Return the newest force [N]; None before the first second is over."""
        for sample in self._driver.read(0.0):
            value = np.asarray(sample["value"], np.float64)
            self._times.append(int(sample["t_ns"]))
            self._values.append(value)
            if self._bias is None:
                self._first.append(value)
                if self._times[-1] - self._times[0] >= SECOND_NS:
                    self._bias = np.mean(self._first, axis=0)
        if self._bias is None or not self._values:
            return None
        x, y, z = (self._values[-1] - self._bias)[:3].tolist()
        return x, y, z

    def wrench(self, t_ns: Times) -> np.ndarray:
        """Return the wrench (n, 6) at times (n,) [ns]; NaN where it was not measured."""
        wrench = np.full((len(t_ns), 6), np.nan)
        if self._bias is None:
            return wrench
        times, values = np.array(self._times), np.stack(self._values) - self._bias
        inside = (t_ns >= times[0]) & (t_ns <= times[-1])
        for axis in range(6):
            wrench[inside, axis] = np.interp(t_ns[inside], times, values[:, axis])
        return wrench


@contextlib.contextmanager
def lab_bench(
    bench: Bench, clock: Clock, stream: str = "", *, say: Callable[[str], None] | None = None
) -> Iterator[Watched]:
    """Open a sensor of a lab bench, by its stream; without a name, the one with the role signal.

    Nothing moves: no connection is made to the arm. With `say`, which is called with a line about
    it, the bench's gauge is opened too.
    """
    row = bench.row(stream) if stream else bench.signal
    if row is None or row.kind not in SIGNALS:
        raise ConfigError(f"{stream or bench.sensor}: no camera and no taxels to watch")
    stream, driver = row.name, row.driver(clock)
    driver.open(bench.preflight.timeout)
    with contextlib.ExitStack() as stack:
        stack.callback(driver.close)
        beside = None if say is None else _gauge(bench, clock, stack, say)
        if beside is None:
            yield Watched(bench.sensor, stream, driver)
        else:
            yield Watched(bench.sensor, stream, driver, wrench=beside.wrench, gauge=beside.newest)


def _gauge(
    bench: Bench, clock: Clock, stack: contextlib.ExitStack, say: Callable[[str], None]
) -> GaugeBeside | None:
    """Open the bench's first gauge; None if there is none, or it does not answer."""
    if not bench.of_kind("force"):
        return None
    row = bench.of_kind("force")[0]
    name, driver = row.name, row.driver(clock)
    try:
        driver.open(bench.preflight.timeout)
    except DeviceLost as error:
        driver.close()
        say(f"{name}: does not answer ({error}); forces are shown without it")
        return None
    stack.callback(driver.close)
    say(f"{name}: its forces are shown beside, relative to those of the first second")
    return GaugeBeside(driver)


@contextlib.contextmanager
def mock_bench(
    file: BenchFile, folder: Path, clock: Clock, *, rate_hz: float | None
) -> Iterator[Watched]:
    """Open the emulated sensor of a mock bench; a finger presses it once `begin` is called."""
    with TouchedMock(file, folder, rate_hz=rate_hz) as mock, lab_bench(mock.bench, clock) as opened:
        pressed = replace(opened, begin=mock.press, check=mock.check)
        yield replace(pressed, shows_ns=_stamped, wrench=mock.wrench)


class RecordedSignal:
    """Signal of a session's first run, played at the recorded times from the first `read` on."""

    dropped = 0

    def __init__(self, path: Path, clock: Clock, name: str = "") -> None:
        """Read a stream of the session; without a name, the one with the role signal."""
        self._session = session = Session(path)
        self._clock = clock
        name = signal_of(session, name)
        self.name = name
        """Name of its stream."""
        self.sensor = sensor_of(session, name)
        """Name of the sensor in the session."""
        self._stream = session.streams[name]
        rows = session.rows_of_run(name, _RUN)
        self._first, last, _ = rows.indices(len(self._stream))
        self._recorded_ns = self._stream.t_ns[rows]
        if self._first == last:
            raise SessionError(f"{path}: no {name} rows in its first run")
        # All signals of a session start together.
        runs = ((one, session.rows_of_run(one, _RUN)) for one in signals_of(session))
        firsts = (session.streams[one].t_ns[rows][:1] for one, rows in runs)
        self._start_ns = int(np.concatenate(list(firsts)).min())
        self._played = 0
        # Difference between the times of playing and recording [ns]; unknown before the first read.
        self._later_ns: int | None = None

    def start(self, start_ns: int) -> None:
        """Set the time at which the session's first row of all signals is played [ns]."""
        self._later_ns = start_ns - self._start_ns

    def over(self) -> bool:
        """Return True if the last row was read."""
        return self._played == len(self._recorded_ns)

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Return the samples that have come since, or wait for the next one for a time [s]."""
        now_ns = self._clock.now_ns()
        if self._later_ns is None:
            self.start(now_ns)
        later_ns = self._later_ns or 0
        if self.over():
            return []
        due_ns = int(self._recorded_ns[self._played]) + later_ns
        self._clock.sleep_until(min(due_ns, now_ns + round(timeout * SECOND_NS)))
        until_ns = self._clock.now_ns() - later_ns
        first, self._played = (
            self._played,
            int(np.searchsorted(self._recorded_ns, until_ns, "right")),
        )
        return [
            {"value": self._value(k), "t_ns": int(self._recorded_ns[k]) + later_ns}
            for k in range(first, self._played)
        ]

    def _value(self, k: int) -> Any:
        row = self._first + k
        if self._stream.layout.image is None:
            return self._stream.array("value")[row]
        return self._stream.jpeg(row) or self._stream.images([row])[0]

    def no_contact(self) -> np.ndarray | None:
        """Return images (n, h, w, 3) or counts (n, 16, 3) up to the first reference, or None."""
        reference, stream = self._session.reference, self._stream
        of_run = np.flatnonzero(reference["run"] == _RUN)
        if not of_run.size:
            return None
        k = int(of_run[0])
        end = int(np.searchsorted(self._recorded_ns, reference["t_ns"][k], "right"))
        column = self._session.columns.get(self.name, "")
        is_image = stream.layout.image is not None
        if is_image and column in reference and reference[column][k] >= 0:
            end = int(reference[column][k]) + 1 - self._first
        rows = np.arange(max(end - _UNTOUCHED, 0), end) + self._first
        if not rows.size:
            return None
        return stream.images(rows) if is_image else np.asarray(stream.array("value"))[rows]

    def wrench(self, t_ns: Times) -> np.ndarray:
        """Return the recorded wrench (n, 6) [N, N m] at times of playing (n,); NaN if none."""
        name = self._session.first("force")
        if name is None:
            return np.full((len(t_ns), 6), np.nan)
        rows, force = self._session.rows_of_run(name, _RUN), self._session.streams[name]
        value = np.asarray(force.array("value"), np.float64)[rows]
        recorded_ns = np.asarray(t_ns, np.int64) - (self._later_ns or 0)
        return linear(force.t_ns[rows], value, recorded_ns).value


def signals_of(session: Session) -> list[str]:
    """Return the streams of a session that can be watched."""
    return [name for kind in SIGNALS for name in session.of_kind(kind)]


def signal_of(session: Session, name: str = "") -> str:
    """Return a stream that can be watched; without a name, the one with the role signal."""
    allowed = signals_of(session)
    if not name and "fingers" in session.attrs:
        raise SessionError(
            f"{session.path}: has the fingers {' and '.join(allowed)}; allowed: --model "
            f"{allowed[0]}=MODEL, and so on"
        )
    if (name or session.signal) not in allowed:
        raise SessionError(
            f"{session.path}: has neither camera nor taxels"
            + (f" named {name}; allowed: {', '.join(allowed)}" if name and allowed else "")
        )
    return name or str(session.signal)


def sensor_of(session: Session, name: str) -> str:
    """Return the name of the sensor of a stream: that of a finger, or the session's."""
    fingers = session.setting("bench").get("fingers") or {}
    return str((fingers.get(name) or {}).get("sensor") or session.attrs.get("sensor", ""))


@contextlib.contextmanager
def replayed(path: Path, clock: Clock, name: str = "") -> Iterator[Watched]:
    """Open a sensor of a recorded session, as `RecordedSignal`."""
    signal = RecordedSignal(path, clock, name)
    more: dict[str, Any] = {"start": signal.start, "over": signal.over, "wrench": signal.wrench}
    yield Watched(signal.sensor, signal.name, signal, signal.no_contact(), **more)


def _stamped(sample: dict[str, Any]) -> int:
    """Return the World's time shown by an emulated sensor; taxels are read when they are sent."""
    value = sample["value"]
    stamp = frame_stamp(value) if isinstance(value, bytes) else None
    return int(sample["t_ns"]) if stamp is None else stamp[1]
