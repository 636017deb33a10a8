"""A recorded session as a sensor: an emulator plays it, the lab's driver reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from recorder import Session, SessionError
from recorder.session import linear
from rig.bench.stream_kinds import KINDS, make_driver
from rig.core.clock import SECOND_NS, Clock
from rig.core.driver import Driver
from rig.core.playback import ENDED, load_recorded_stream
from rig.core.shared_memory import SharedLatest
from rig.mock.players import Players, playback_hosts, replay_bench
from rig.mock.processes import StartedOrClosed

# The first run: later ones were recorded after a stop.
_RUN = 0
_LEAD_NS = SECOND_NS // 10
# Frames before the session's first reference that are taken as without contact.
_UNTOUCHED = 10


class ReplayedSensor(StartedOrClosed):
    """Context manager that plays the signal of a session at the recorded times.

    Args:
        path: The session.
        folder: Empty run folder.
        clock: Clock.
    """

    def __init__(self, path: Path, folder: Path, clock: Clock) -> None:
        self._session = Session(path)
        self.stream = _stream(self._session, path)
        """Name of the stream."""
        self.sensor = str(self._session.attrs.get("sensor", ""))
        """Name of the sensor in the session."""
        self._clock = clock
        self._start_ns = 0
        self._closed = False
        recording = load_recorded_stream(self._session, (self.stream,), self.stream, _RUN)
        if not len(recording.t_ns):
            raise SessionError(f"{path}: no {self.stream} rows in its first run")
        self._origin_ns = int(recording.stream.t_ns[recording.rows.start]) - int(recording.t_ns[0])
        names = (self.stream,)
        hosts = playback_hosts(names)
        bench = replay_bench(self._session, names, hosts, 1.0)
        self._timeout = bench.preflight.timeout
        kind = KINDS[self._session.streams[self.stream].traits.kind]
        # The player reads the number of rows taken here, to wait for a slow reader.
        self._latest = SharedLatest.create(folder / f"{self.stream}.latest", kind.latest)
        self._players = Players(path, names, _RUN, hosts, folder, clock, speed=1.0)
        self.driver: Driver = _Counted(make_driver(bench, self.stream, clock), self._latest, kind)

    def _start(self) -> None:
        self._players.__enter__()
        self.driver.open(self._timeout)

    def play(self) -> None:
        """Start playback."""
        self._start_ns = self._clock.now_ns() + _LEAD_NS
        self._players.start_playback(self._start_ns)

    def over(self) -> bool:
        """Return True if the last row was sent."""
        positions = self._players.positions().values()
        return all(one is not None and one["state"] == ENDED for one in positions)

    def check(self) -> None:
        """Raise if a player ended or failed.

        Raises:
            DeviceLost: Names it, with its last line of output.
        """
        self._players.check()

    def no_contact(self) -> np.ndarray | None:
        """Return images (n, h, w, 3) or counts (n, 16, 3) up to the first reference, None without.

        Raises:
            SessionError: The images are corrupt.
        """
        reference = self._session.reference
        stream = self._session.streams[self.stream]
        first, last, _ = self._session.rows_of_run(self.stream, _RUN).indices(len(stream))
        (taken,) = np.flatnonzero(reference["run"] == _RUN)[:1].tolist() or (None,)
        if taken is None:
            return None
        end = int(np.searchsorted(stream.t_ns[first:last], reference["t_ns"][taken], "right"))
        column = self._session.columns.get(self.stream, "")
        image = stream.layout.image is not None
        if image and column in reference and reference[column][taken] >= 0:
            end = int(reference[column][taken]) + 1 - first
        rows = np.arange(max(end - _UNTOUCHED, 0), end) + first
        if not rows.size:
            return None
        if image:
            return stream.images(rows)
        return np.asarray(stream.array("value"))[rows]

    def wrench(self, t_ns: np.ndarray) -> np.ndarray:
        """Return the recorded wrench (n, 6) [N, N m] of frames arriving at (n,); NaN if none."""
        session = self._session
        name = session.first("force")
        if name is None:
            return np.full((len(t_ns), 6), np.nan)
        rows = session.rows_of_run(name, _RUN)
        force = session.streams[name]
        recorded = np.asarray(t_ns, np.int64) - self._start_ns + self._origin_ns
        value = np.asarray(force.array("value"), np.float64)[rows]
        return linear(force.t_ns[rows], value, recorded).value

    def close(self) -> None:
        """End driver and player; may be called twice."""
        if self._closed:
            return
        self._closed = True
        self._players.wake()
        self.driver.close()
        self._players.close()
        self._latest.close()


class _Counted:
    """Driver that publishes its count of samples for the player."""

    def __init__(self, driver: Driver, latest: SharedLatest, kind: Any) -> None:
        self._driver, self._latest, self._kind = driver, latest, kind
        self._row = -1

    @property
    def dropped(self) -> int:
        return self._driver.dropped

    def open(self, timeout: float) -> None:
        self._driver.open(timeout)

    def read(self, timeout: float) -> list[dict[str, Any]]:
        samples = self._driver.read(timeout)
        for sample in samples:
            self._row += 1
            self._latest.write(self._kind.record(sample, self._row))
        return samples

    def describe(self) -> dict[str, Any]:
        return self._driver.describe()

    def close(self) -> None:
        self._driver.close()


def _stream(session: Session, path: Path) -> str:
    """Return the name of the signal.

    Raises:
        SessionError: There is none, or nothing can play it.
    """
    name = session.signal
    if name is None or session.streams[name].traits.kind not in ("camera", "taxels"):
        raise SessionError(f"{path}: has neither camera nor taxels")
    stream = session.streams[name]
    if stream.layout.image is not None and stream.jpeg_shape is None:
        raise SessionError(
            f"{path}: its images are stored as pixels; allowed: JPEG, as a camera sends them"
        )
    return name
