"""Replay of one run: emulators and drivers, from the first connection to the last row."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from recorder import Session, StreamSpec
from recorder.progress import duration
from rig.acquire.control import InterruptFlag
from rig.acquire.streams import StreamHandle
from rig.bench.bench import Bench
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import DeviceLost
from rig.core.playback import ENDED, load_recorded_stream
from rig.core.shared_memory import SharedLatest
from rig.devices.force.netft_recorded import force_bias
from rig.mock.players import Players

logger = logging.getLogger(__name__)

# Conditions for the end of a run, and for giving up on it.

# Longest time for a stream's last rows to arrive after its emulator has sent them all [s].
MISSING_TIMEOUT = 5.0
# Longest time without progress while rows are left, added to the longest recorded gap [s].
STALL_TIMEOUT = 30.0


class EndOfTape:
    """Checks repeatedly if every stream has all its rows.

    `gap` is the longest time without a row in the recording itself [s].
    """

    def __init__(self, totals: Mapping[str, int], gap: float) -> None:
        self._totals = dict(totals)
        self._gap = gap
        self._seen: dict[str, tuple[int, int]] = {}
        self._changed_ns: dict[str, int] = {}

    def reached(
        self, now_ns: int, taken: Mapping[str, int], positions: Mapping[str, np.void | None]
    ) -> bool:
        """Return True if all rows of all streams have been taken.

        `taken` are the rows taken by each stream's process, `positions` the POSITION of each
        emulator.
        """
        for name, total in self._totals.items():
            if taken[name] > total:
                raise DeviceLost(f"{name}: {taken[name] - total} rows more than were sent")
        if all(taken[name] == total for name, total in self._totals.items()):
            return True
        moving = False
        for name in self._totals:
            position = positions[name]
            sent = 0 if position is None else int(position["sent"])
            if self._seen.get(name) != (sent, taken[name]) or name not in self._changed_ns:
                self._seen[name] = (sent, taken[name])
                self._changed_ns[name] = now_ns
                moving = True
        for name, total in self._totals.items():
            position = positions[name]
            still = (now_ns - self._changed_ns[name]) / SECOND_NS
            ended = position is not None and position["state"] == ENDED
            missing = total - taken[name]
            if missing and ended and still > MISSING_TIMEOUT:
                raise DeviceLost(
                    f"{name}: {missing} of {total} rows are missing {still:.0f} s after its "
                    "emulator had sent all"
                )
        stalled = (now_ns - max(self._changed_ns.values())) / SECOND_NS
        if not moving and stalled > STALL_TIMEOUT + self._gap:
            left = {name: total - taken[name] for name, total in self._totals.items()}
            raise DeviceLost(f"replay: no progress for {stalled:.0f} s; rows missing: {left}")
        return False


# Samples that a driver delivers before playback starts, because it needs them to open, by kind.
_LEAD_IN = {"force": 1, "taxels": 1, "pose": 0, "arm_wrench": 0, "camera": 0}
_SETTLE_NS = SECOND_NS // 5
_SETTLE_TIMEOUT = 10.0
# Time from the cue to the start of playback; emulators poll the cue 200 times per second.
_LEAD_NS = SECOND_NS // 10
_LOOK_NS = SECOND_NS // 50
_SAY_NS = 5 * SECOND_NS


class ReplayedRun:
    """Context manager for the emulators and streams of one run.

    Args:
        source: The session to replay.
        names: Its streams to replay.
        run: Number of the run.
        bench: Addresses of the emulators.
        hosts: Loopback address of each stream's emulator.
        folder: Empty run folder.
        clock: Clock.
        speed: Multiple of the recorded speed; 0: as fast as read.
    """

    def __init__(
        self,
        source: Session,
        names: tuple[str, ...],
        run: int,
        bench: Bench,
        hosts: Mapping[str, str],
        folder: Path,
        clock: Clock,
        *,
        speed: float,
    ) -> None:
        self._source = source
        self._hosts = hosts
        self._kinds = {name: source.streams[name].traits.kind for name in names}
        self._names = names
        self._run = run
        self._bench = bench
        self._folder = folder
        self._clock = clock
        self._speed = speed
        recorded_streams = {name: load_recorded_stream(source, names, name, run) for name in names}
        self.totals = {name: len(recorded.rows) for name, recorded in recorded_streams.items()}
        ends = [
            int(recorded.t_ns.max()) for recorded in recorded_streams.values() if len(recorded.t_ns)
        ]
        self.seconds = max(ends, default=0) / SECOND_NS
        """Recorded duration of the run [s]."""
        times = np.sort(
            np.concatenate([[0], *(recorded.t_ns for recorded in recorded_streams.values())])
        )
        self._gap = float(np.diff(times).max(initial=0)) / SECOND_NS / (speed or 1.0)
        self._players: Players | None = None
        self._handles: dict[str, StreamHandle] = {}
        self._latest: dict[str, SharedLatest] = {}
        self._base: dict[str, int] = {}

    def __enter__(self) -> ReplayedRun:
        self._players = Players(
            self._source.path,
            self._names,
            self._run,
            self._hosts,
            self._folder,
            self._clock,
            speed=self._speed,
        ).__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        players, self._players = self._players, None
        try:
            if players is not None:
                players.wake()
            for handle in self._handles.values():
                handle.close()
        finally:
            for record in self._latest.values():
                record.close()
            if players is not None:
                players.close()

    def open(self, interrupt: InterruptFlag) -> dict[str, dict[str, Any]]:
        """Open every driver and return the properties of the devices, by stream.

        Those of cameras are opened last: such a driver waits for the next frame with a timeout
        that also delays closing, so that timeout is short.
        """
        description = {}
        cameras = [name for name in self._names if self._kinds[name] == "camera"]
        for names in ([name for name in self._names if name not in cameras], cameras):
            for name in names:
                self._handles[name] = StreamHandle(name, self._bench, self._folder)
                path = self._folder / f"{name}.latest"
                self._latest[name] = SharedLatest.attach(path, self._bench.row(name).latest)
            for name in names:
                interrupt.check()
                description[name] = self._handles[name].wait_opened()
        for name, handle in self._handles.items():
            if self._kinds[name] == "force":
                handle.set_bias(force_bias(self._source.streams[name]))
        self._settle(interrupt)
        return description

    def spec(self, name: str, description: dict[str, Any], attrs: dict[str, Any]) -> StreamSpec:
        """Return a stream's storage spec: device as found by the driver, rest from the source."""
        rate_hz = self._source.streams[name].rate_hz
        return self._bench.row(name).spec(description, rate_hz, **attrs)

    def record(self, name: str, path: Path) -> None:
        """Append the stream's samples to the group at `path` from now on."""
        self._handles[name].record(path)

    def start_playback(self) -> int:
        """Start playback and return the time at which its first row is due [ns]."""
        players = self._started()
        self._base = {name: record.count for name, record in self._latest.items()}
        start_ns = self._clock.now_ns() + _LEAD_NS
        players.start_playback(start_ns)
        return start_ns

    def watch(self, interrupt: InterruptFlag) -> None:
        """Wait until every stream has all its rows."""
        players = self._started()
        end = EndOfTape(self.totals, self._gap)
        start_ns = said_ns = self._clock.now_ns()
        while True:
            interrupt.check()
            for handle in self._handles.values():
                handle.check()
            players.check()
            taken = {name: record.count - self._base[name] for name, record in self._latest.items()}
            now_ns = self._clock.now_ns()
            if end.reached(now_ns, taken, players.positions()):
                return
            if now_ns - said_ns >= _SAY_NS:
                said_ns = now_ns
                self._say(taken, (now_ns - start_ns) / SECOND_NS)
            self._clock.sleep_until(now_ns + _LOOK_NS)

    def _settle(self, interrupt: InterruptFlag) -> None:
        """Wait until the samples that the drivers needed to open have passed; they hold no row."""
        begun_ns = changed_ns = self._clock.now_ns()
        before: dict[str, int] = {}
        while True:
            interrupt.check()
            counts = {name: record.count for name, record in self._latest.items()}
            now_ns = self._clock.now_ns()
            if counts != before:
                before, changed_ns = counts, now_ns
            enough = all(count >= _LEAD_IN[self._kinds[name]] for name, count in counts.items())
            if enough and now_ns - changed_ns >= _SETTLE_NS:
                return
            if now_ns - begun_ns > _SETTLE_TIMEOUT * SECOND_NS:
                raise DeviceLost(f"replay: drivers are open but show no sample: {counts}")
            for handle in self._handles.values():
                handle.check()
            self._clock.sleep_until(now_ns + _LOOK_NS)

    def _say(self, taken: dict[str, int], seconds: float) -> None:
        total = sum(self.totals.values())
        done = sum(taken.values()) / total if total else 1.0
        left = seconds * (1 - done) / done if done > 0 else self.seconds
        rows = "  ".join(f"{name} {taken[name]}/{self.totals[name]}" for name in self._names)
        logger.info("replay %3.0f %%  %s  %s left", 100 * done, rows, duration(left))

    def _started(self) -> Players:
        if self._players is None:
            raise DeviceLost("replay: its emulators are not running")
        return self._players
