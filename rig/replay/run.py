"""One run being replayed: emulators and drivers, from the first connection to the last row."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from recorder import Session, StreamSpec
from rig.bench import Bench
from rig.clock import SECOND_NS, Clock
from rig.collect.interrupt import InterruptFlag
from rig.collect.live import minutes
from rig.errors import DeviceLost
from rig.replay.players import Players
from rig.replay.progress import EndOfTape
from rig.replay.tape import load_tape
from rig.replay.wire import force_bias
from rig.shared import LatestRecord
from rig.streams.handle import StreamHandle
from rig.streams.kinds import KINDS, stream_spec

logger = logging.getLogger(__name__)

_LEAD_IN = {"force": 1, "taxels": 1, "pose": 0, "camera": 0}
"""Samples a driver hands on before the tape starts: what it needed to open."""
_SETTLE_NS = SECOND_NS // 5
_SETTLE_TIMEOUT = 10.0
_LEAD_NS = SECOND_NS // 10
# The tape starts this long after the cue: emulators look for it 200 times a second.
_LOOK_NS = SECOND_NS // 50
_SAY_NS = 5 * SECOND_NS


class ReplayedRun:
    """Emulators and streams of one run, as a context manager.

    Args:
        source: The session that is replayed.
        names: Its streams to replay.
        run: Which of its runs.
        bench: Addresses of the emulators.
        folder: Empty run folder.
        clock: Clock.
        speed: Times the recorded one; 0: as fast as read.
    """

    def __init__(
        self,
        source: Session,
        names: tuple[str, ...],
        run: int,
        bench: Bench,
        folder: Path,
        clock: Clock,
        *,
        speed: float,
    ) -> None:
        self._source = source
        self._names = names
        self._run = run
        self._bench = bench
        self._folder = folder
        self._clock = clock
        self._speed = speed
        tapes = {name: load_tape(source, names, name, run) for name in names}
        self.totals = {name: len(tape.rows) for name, tape in tapes.items()}
        ends = [int(tape.t_ns.max()) for tape in tapes.values() if len(tape.t_ns)]
        self.seconds = max(ends, default=0) / SECOND_NS
        """Length of the tape as recorded [s]."""
        times = np.sort(np.concatenate([[0], *(tape.t_ns for tape in tapes.values())]))
        self._gap = float(np.diff(times).max(initial=0)) / SECOND_NS / (speed or 1.0)
        self._players: Players | None = None
        self._handles: dict[str, StreamHandle] = {}
        self._latest: dict[str, LatestRecord] = {}
        self._base: dict[str, int] = {}

    def __enter__(self) -> ReplayedRun:
        self._players = Players(
            self._source.path,
            self._names,
            self._run,
            self._bench.arm.host,
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
        """Open every driver; the facts of the devices, by stream.

        The camera's comes last: its driver waits for the next frame with a time-out that closing
        would have to wait for as well, so that one is short.

        Raises:
            ConfigError, DeviceLost, Interrupted: What the first driver to fail found.
        """
        facts = {}
        early = [name for name in self._names if name != "camera"]
        for names in (early, [name for name in self._names if name == "camera"]):
            for name in names:
                self._handles[name] = StreamHandle(name, self._bench, self._folder)
                path = self._folder / f"{name}.latest"
                self._latest[name] = LatestRecord.attach(path, KINDS[name].latest)
            for name in names:
                interrupt.check()
                facts[name] = self._handles[name].wait_opened()
        if "force" in self._handles:
            self._handles["force"].set_bias(force_bias(self._source.streams["force"]))
        self._settle(interrupt)
        return facts

    def spec(self, name: str, facts: dict[str, Any], attrs: dict[str, Any]) -> StreamSpec:
        """How a stream is stored: its device as the driver found it, the rest as in the source."""
        rate_hz = self._source.streams[name].rate_hz
        return stream_spec(self._bench, name, facts, rate_hz, **attrs)

    def record(self, name: str, path: Path) -> None:
        """Append the stream's samples to the group at `path` from now on."""
        self._handles[name].record(path)

    def cue(self) -> int:
        """Start the tape; when its first row is due [ns]."""
        players = self._started()
        self._base = {name: record.count for name, record in self._latest.items()}
        start_ns = self._clock.now_ns() + _LEAD_NS
        players.cue(start_ns)
        return start_ns

    def watch(self, interrupt: InterruptFlag) -> None:
        """Return when every stream has every row.

        Raises:
            DeviceLost, SessionError, Interrupted: What ended it before.
        """
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
        """Wait until what the drivers needed to open has gone through: no row may be among it.

        Raises:
            DeviceLost: It does not come.
        """
        begun_ns = changed_ns = self._clock.now_ns()
        before: dict[str, int] = {}
        while True:
            interrupt.check()
            counts = {name: record.count for name, record in self._latest.items()}
            now_ns = self._clock.now_ns()
            if counts != before:
                before, changed_ns = counts, now_ns
            enough = all(count >= _LEAD_IN[name] for name, count in counts.items())
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
        logger.info("replay %3.0f %%  %s  %s left", 100 * done, rows, minutes(left))

    def _started(self) -> Players:
        if self._players is None:
            raise DeviceLost("replay: its emulators are not running")
        return self._players
