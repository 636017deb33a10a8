"""Playback of a recorded stream by an emulator, at its own times or as fast as it is read.

At any speed, a row is sent only while fewer than `window` rows are under way; the reader's count of
samples is read from shared memory, so no socket or inbox overflows. At maximum speed the emulators
are also synchronised: none is more than `STEP_NS` of recorded time ahead of the slowest reader.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rig.core.clock import SECOND_NS, Clock
from rig.core.emulation import EmulatorConfig
from rig.core.realtime import CAMERA_PRIORITY, DEVICE_PRIORITY
from rig.core.samples import latest_dtype
from rig.core.shared_memory import SharedLatest

if TYPE_CHECKING:
    from recorder.session import Session, Stream

logger = logging.getLogger(__name__)

# Records in shared memory between the replaying process and its emulators.

# Start time of playback [ns], written once all drivers are open and all writers record.
SYNC = np.dtype([("start_ns", "<i8")])
# Codes of `POSITION.state`.
WAITING, PLAYING, ENDED, FAILED = range(4)
# Progress of an emulator: its state, rows sent, and the recorded time of the first row that its
# reader has not taken, relative to the run's first sample [ns].
POSITION = np.dtype([("state", "<i8"), ("sent", "<i8"), ("t_ns", "<i8")])
# `POSITION.t_ns` of an emulator all of whose rows have been taken.
FAR_NS = np.iinfo(np.int64).max // 2

STEP_NS = SECOND_NS // 50
# Pauses between two looks at a condition: they double while it does not hold, because a dozen
# emulators that look 5,000 times per second each leave no time for the readers they wait for.
_NAP_NS, _LONGEST_NAP_NS = 200_000, 5_000_000
_SLICE_NS = SECOND_NS // 20
# Pauses between wake-ups [s]: fewer than the 10 corrupt frames in a row that mean a lost camera.
_WAKE_PAUSES = (0.05, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)


def sync_path(folder: Path) -> Path:
    """Return the path of a run folder's SYNC record."""
    return folder / "replay.cue"


def position_path(folder: Path, name: str) -> Path:
    """Return the path of an emulator's POSITION record."""
    return folder / f"{name}.position"


@dataclass(frozen=True, slots=True)
class RecordedStream:
    """Rows of one stream in one run."""

    stream: Stream
    """Stream that contains the rows."""
    rows: range
    """Indices of the rows."""
    t_ns: npt.NDArray[np.int64]
    """Times of the rows since the run's first sample in any stream [ns]."""


def times_of_run(session: Session, name: str, run: int) -> npt.NDArray[np.int64]:
    """Return the recorded times (n,) of the rows of a stream in a run [ns]."""
    return session.streams[name].t_ns[session.rows_of_run(name, run)]


def origin_ns(session: Session, names: Sequence[str], run: int) -> int | None:
    """Return the recorded time of a run's first sample in any stream [ns]; None without samples."""
    every = (times_of_run(session, name, run) for name in names)
    return min((int(times.min()) for times in every if len(times)), default=None)


def load_recorded_stream(
    session: Session, names: Sequence[str], name: str, run: int
) -> RecordedStream:
    """Return the rows of stream `name` in a run, timed from the first sample of any of `names`."""
    stream = session.streams[name]
    rows = session.rows_of_run(name, run)
    start = origin_ns(session, names, run) or 0
    return RecordedStream(stream, range(*rows.indices(len(stream))), stream.t_ns[rows] - start)


def stated_rate(stream: Stream) -> float:
    """Return the rate that the device stated [Hz], else the stream's own."""
    device = stream.attrs.get("device") or {}
    return float(device.get("rate_hz") or stream.rate_hz)


@dataclass(frozen=True, slots=True)
class Recording:
    """Recorded stream that an emulator plays in place of the World's states."""

    session: Path
    stream: str
    """Name of the stream."""
    folder: Path
    """Run folder with the shared records."""
    streams: tuple[str, ...] = ()
    """Streams that are played at the same time."""
    run: int = 0
    """Number of the run in the session."""
    speed: float = 1.0
    """Multiple of the recorded speed; 0: as fast as read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayableConfig(EmulatorConfig):
    """Settings of an emulator that serves the World, or plays a recording."""

    recording: Recording | None = None
    """Recorded stream to play; None: the World."""

    def playback(self, clock: Clock) -> Playback | None:
        """Return the playback of the recording; None: serve the World."""
        return None if self.recording is None else Playback(self.recording, clock)

    @property
    def priority(self) -> int:
        """Requested real-time priority."""
        # At maximum speed the readers set the pace, so no emulator may keep one from running.
        fast = self.recording is not None and self.recording.speed == 0
        return CAMERA_PRIORITY if fast else DEVICE_PRIORITY


class Playback:
    """Rows of a recorded stream in the order and at the pace in which an emulator sends them."""

    def __init__(self, recording: Recording, clock: Clock) -> None:
        from recorder.session import Session  # not needed to serve the World

        name, folder = recording.stream, recording.folder
        others = [other for other in recording.streams if other != name]
        session = Session(recording.session)
        self.recorded = load_recorded_stream(session, (name, *others), name, recording.run)
        self._name = name
        self._folder = folder
        self._clock = clock
        self._speed = recording.speed
        self._others = others if recording.speed == 0 else []
        self._sync = SharedLatest.attach(sync_path(folder), SYNC)
        path = position_path(folder, name)
        self._position = SharedLatest.attach(path, POSITION, writable=True)
        self._sent = 0
        self._ending = threading.Event()
        self._idle: Callable[[], None] = _nothing

    def run(
        self,
        send: Callable[[int], None],
        *,
        window: int,
        ending: threading.Event,
        idle: Callable[[], None] | None = None,
        wake: Callable[[], None] | None = None,
    ) -> None:
        """Wait for the start, send every row, and wait for the end of the replay.

        `send` sends the row at a place of the recording, at most `window` under way to the reader;
        `idle` is called about 20 times per second while no row is due. `ending` is set when the
        emulator closes; `wake` then wakes a reader that waits for a row, without sending one.
        """
        self._ending = ending
        self._idle = idle or _nothing
        try:
            self._tell(WAITING, 0)
            start_ns = self._await_start()
            if start_ns is not None:
                self._play(start_ns, send, window)
            self._await_end(wake or _nothing)
        except Exception as error:
            # The replay must learn of any error, because this thread is the whole device.
            if not ending.is_set():
                self._tell(FAILED, FAR_NS)
                logger.error("after row %d: %s", self._sent - 1, error)

    def _tell(self, state: int, t_ns: int) -> None:
        self._position.write((state, self._sent, t_ns))

    @property
    def _over(self) -> bool:
        """True if the replay has ended, as signalled by the second cue."""
        return self._sync.count > 1 or self._ending.is_set()

    def _await_start(self) -> int | None:
        while not self._ending.wait(_SLICE_NS / SECOND_NS / 10):
            sync = self._sync.read()
            if sync is not None:
                return None if self._over else int(sync["start_ns"])
            self._idle()
        return None

    def _await_end(self, wake: Callable[[], None]) -> None:
        """Serve the client until the replay has ended, then help it to close."""
        while not self._over:
            self._idle()
            self._ending.wait(_SLICE_NS / SECOND_NS)
        for pause in _WAKE_PAUSES:
            if self._ending.wait(pause):
                return
            wake()

    def _play(self, start_ns: int, send: Callable[[int], None], window: int) -> None:
        times = self.recorded.t_ns
        stream = self.recorded.stream
        dtype = latest_dtype(stream.traits.kind, stream.layout.columns[0].column.shape)
        latest = SharedLatest.attach(self._folder / f"{self._name}.latest", dtype)
        step = _Step(self._folder, self._others)
        base = latest.count
        try:
            for row in range(len(times)):
                if self._speed > 0:
                    self._sleep_until(start_ns + round(int(times[row]) / self._speed))

                def is_due(row: int = row) -> bool:
                    read = latest.count - base
                    self._tell(PLAYING, int(times[min(max(read, 0), row)]))
                    return row - read < window and step.allows(int(times[row]))

                if not self._waited(is_due):
                    return
                send(row)
                self._sent = row + 1

            def is_drained() -> bool:
                read = latest.count - base
                done = read >= len(times)
                self._tell(ENDED, FAR_NS if done else int(times[max(read, 0)]))
                return done

            self._waited(is_drained)
        finally:
            latest.close()
            step.close()

    def _sleep_until(self, due_ns: int) -> None:
        while not self._over:
            now_ns = self._clock.now_ns()
            if due_ns - now_ns <= _SLICE_NS:
                self._clock.sleep_until(due_ns)
                return
            self._clock.sleep_until(now_ns + _SLICE_NS)
            self._idle()

    def _waited(self, condition: Callable[[], bool]) -> bool:
        """Wait for `condition`; return False if stopped first."""
        idle_ns = self._clock.now_ns() + _SLICE_NS
        nap_ns = _NAP_NS
        while not condition():
            if self._over:
                return False
            now_ns = self._clock.now_ns()
            if now_ns >= idle_ns:
                self._idle()
                idle_ns = now_ns + _SLICE_NS
            self._clock.sleep_until(now_ns + nap_ns)
            nap_ns = min(2 * nap_ns, _LONGEST_NAP_NS)
        return not self._over


def _nothing() -> None:
    pass


class _Step:
    """Synchronisation with the other emulators' positions."""

    def __init__(self, folder: Path, others: Sequence[str]) -> None:
        self._records = [
            SharedLatest.attach(position_path(folder, name), POSITION) for name in others
        ]
        self._reached_ns = 0

    def allows(self, t_ns: int) -> bool:
        # Positions only advance, so none is read while the last reading allows the row.
        if t_ns <= self._reached_ns + STEP_NS or not self._records:
            return True
        reached_ns = FAR_NS
        for index, record in enumerate(self._records):
            position = record.read()
            at_ns = 0 if position is None else int(position["t_ns"])
            if t_ns > at_ns + STEP_NS:
                # Read first from now on, and alone until it has moved.
                self._records.insert(0, self._records.pop(index))
                return False
            reached_ns = min(reached_ns, at_ns)
        self._reached_ns = reached_ns
        return True

    def close(self) -> None:
        for record in self._records:
            record.close()
