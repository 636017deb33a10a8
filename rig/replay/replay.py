"""Replay of a session: its streams sent by emulators, recorded again by the real drivers.

No arm is commanded. Runs are replayed one after the other, each with its own emulators, drivers
and clock anchor, as `collect --resume` would record them; device clocks and sequence numbers that
restart with a run therefore restart in the replay too.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE, EXIT_INTERRUPTED
from recorder.command_line.options import next_command
from recorder.errors import SessionError
from recorder.info import session_digest, stream_digest
from recorder.progress import ItemProgress, duration
from recorder.session import Session, SessionWriter, StreamWriter
from recorder.spec import StreamSpec, action_spec
from rig.acquire.collector import software
from rig.acquire.control import Interrupted, InterruptFlag
from rig.acquire.streams import StreamHandle
from rig.bench.bench import Bench
from rig.core.clock import SECOND_NS, Clock, ClockAnchor, SystemClock
from rig.core.errors import DeviceLost
from rig.core.playback import ENDED, load_recorded_stream
from rig.core.shared_memory import SharedLatest
from rig.devices.force.netft_emulator import force_bias
from rig.mock.players import Players, playback_hosts, replay_bench
from rig.replay.comparison import (
    Retiming,
    compared,
    covered_ns,
    retiming,
    span,
    timing,
    timing_line,
)
from rig.replay.replayable import replayable

logger = logging.getLogger(__name__)

EXIT_DIFFERENT = 1
# Attributes of the source that also apply to the replay.
_COPIED = (
    *("sensor", "indenter", "operator", "plan", "targets_wanted", "bench", "contact_frame"),
    *("calibration", "expected", "expected_force", "imported", "mock_sources", "fingers"),
)
# Attributes of a stream that the replay writes itself.
_OWN_ATTRS = {"columns", "rate_hz", "sync_interval", "device", "device_clock", "clock_fit"}
_OWN_ATTRS |= {"kind", "clock"}


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """Request of the operator."""

    source: Path
    """The session to replay."""
    out: Path
    """The session to write."""
    speed: float = 1.0
    """Multiple of the recorded speed; 0: as fast as the drivers read."""
    without: tuple[str, ...] = ()
    """Streams to leave out."""

    @property
    def speed_name(self) -> float | str:
        """Speed as it is stored and shown."""
        return self.speed if self.speed > 0 else "max"


class Replay:
    """One replay, from checking the source to the final summary."""

    def __init__(self, request: ReplayRequest) -> None:
        self._request = request
        self._clock = SystemClock()
        self._source = Session(request.source)
        self._names: tuple[str, ...] = ()
        self._hashes: dict[str, str] = {}
        self._writer: SessionWriter | None = None
        self._maps: dict[int, Retiming] = {}
        self._start_ns: dict[int, int] = {}

    def run(self) -> int:
        """Replay and return the exit code; recorded data is closed and readable however it ends."""
        request, source = self._request, self._source
        if request.out.exists():
            raise SessionError(f"{request.out}: exists already; choose another name")
        with ItemProgress("images checked", sys.stderr) as progress:
            self._names = replayable(source, request.without, progress)
        self._hashes = _digests("images read", source, self._names)
        stop: BaseException | None = None
        with InterruptFlag() as interrupt:
            try:
                self._replay_runs(interrupt)
            except BaseException as error:
                # On any error, the session is closed before anything else.
                stop = error
            if self._writer is None:
                if stop is not None:
                    raise stop
                raise SessionError(f"{request.source}: no rows to replay")
            interrupt.ignore()
            try:
                self._finish(self._writer, stop)
            except (SessionError, OSError) as error:
                out = request.out
                print(
                    f"{out}: could not be finished ({error}); its samples are kept: make room, "
                    f"then run: {next_command('session', 'recover', out)}",
                    file=sys.stderr,
                )
                return EXIT_DEVICE_LOST
        if stop is not None:
            return self._stopped(stop)
        return self._report()

    def _replay_runs(self, interrupt: InterruptFlag) -> None:
        speed, source, names = self._request.speed, self._source, self._names
        for run in range(max(len(source.runs), 1)):
            with contextlib.ExitStack() as stack:
                folder = Path(
                    stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-"))
                )
                hosts = playback_hosts(source, names, folder)
                bench = replay_bench(source, names, hosts, speed)
                replayed = ReplayedRun(
                    source, names, run, bench, hosts, folder, self._clock, interrupt, speed=speed
                )
                if not replayed.seconds and not any(replayed.totals.values()):
                    continue
                stack.enter_context(replayed)
                description = replayed.open()
                if self._writer is None:
                    self._writer = self._create(description, replayed)
                self._writer.begin_run({**asdict(ClockAnchor.take()), "devices": description})
                for name in names:
                    replayed.record(name, self._writer.stream_path(name))
                self._start_ns[run] = replayed.start_playback()
                replayed.watch()

    def _create(self, description: dict[str, Any], replayed: ReplayedRun) -> SessionWriter:
        source, request, names = self._source, self._request, self._names
        attrs = source.attrs
        anchor = ClockAnchor.take()
        own = {
            "mock": True,
            "started_utc": f"{np.datetime64(anchor.utc_ns, 'ns')}Z",
            "clock": "CLOCK_MONOTONIC",
            "t0_ns": anchor.t0_ns,
            "software": software(),
            "replay_of": {
                "name": source.path.name,
                "sha256": session_digest(self._hashes),
                "streams": self._hashes,
                "left_out": sorted({*source.streams} - {*names, *source.of_kind("action")}),
                "speed": request.speed_name,
                "status": source.status,
                "mock": attrs.get("mock"),
                "started_utc": attrs.get("started_utc"),
                "rate_hz": source.rate_hz,
            },
        }
        specs = [
            replayed.spec(
                name,
                description[name],
                {k: v for k, v in source.streams[name].attrs.items() if k not in _OWN_ATTRS},
            )
            for name in names
        ]
        specs += [action_spec(name=name) for name in source.of_kind("action")]
        return SessionWriter.create(
            request.out,
            attrs={**{key: attrs[key] for key in _COPIED if key in attrs}, **own},
            streams=specs,
            targets=dict(source.targets),
        )

    def _finish(self, writer: SessionWriter, stop: BaseException | None) -> None:
        names = self._names
        if stop is not None:
            for name in names:
                # A stream whose process was killed has rows that only a writer recovers.
                StreamWriter.open(writer.stream_path(name)).close()
        replay = Session(writer.path)
        runs = list(self._start_ns)
        for number, run in enumerate(runs):
            start_ns = self._start_ns[run]
            # A run without any row has no counterpart, so runs of the replay are renumbered.
            if number != run:
                logger.warning("run %d of the source is run %d of the replay", run, number)
            self._maps[run] = retiming(
                self._source, replay, names, run, start_ns, self._request.speed
            )
        covered = {run: covered_ns(replay, names, number) for number, run in enumerate(runs)}
        numbers = {run: number for number, run in enumerate(runs)}
        for row in _rows(self._source.segments):
            run = int(row["run"])
            if run not in self._maps:
                continue
            times = np.array([row["start_ns"], row["end_ns"]], np.int64)
            start_ns, end_ns = (int(t) for t in self._maps[run](times))
            if stop is not None and end_ns > covered[run]:
                continue
            end_ns = max(end_ns, start_ns + 1)
            moved = {"run": numbers[run], "start_ns": start_ns, "end_ns": end_ns}
            writer.segments.append(**{**row, **moved})
        for row in _rows(self._source.reference):
            run = int(row["run"])
            if run not in self._maps:
                continue
            (t_ns,) = self._maps[run](np.array([row["t_ns"]], np.int64))
            if stop is not None and t_ns > covered[run]:
                continue
            moved = {"run": numbers[run], "t_ns": int(t_ns), "point": row["point"]}
            writer.reference.append(**{**_no_contact(self._source, replay, row), **moved})
        for name in self._source.of_kind("action"):
            self._copy_commands(name, writer)
        status, reason = "complete", ""
        if stop is not None:
            status, reason = "stopped", f"replay: {str(stop) or type(stop).__name__}"
        writer.finish(
            status,
            reason,
            rate_hz=self._source.rate_hz * self._faster(replay),
            # At another speed the devices' clocks are slower than the host's by that factor.
            clocks=self._request.speed == 1.0,
        )

    def _copy_commands(self, name: str, writer: SessionWriter) -> None:
        """Copy commands, which no device sends, to their times in the replay."""
        stream = self._source.streams[name]
        with StreamWriter.open(writer.stream_path(name)) as out:
            for run, moved in self._maps.items():
                rows = self._source.rows_of_run(name, run)
                columns = {column: stream.array(column)[rows] for column in stream.names}
                for k, t_ns in enumerate(moved(columns["t_ns"])):
                    row = {column: values[k] for column, values in columns.items()}
                    out.append(**{**row, "t_ns": int(t_ns)})

    def _faster(self, replay: Session) -> float:
        """Return the playback speed relative to the recording."""
        if self._request.speed > 0:
            return self._request.speed
        recorded, replayed = self._seconds(replay)
        return recorded / replayed if recorded > 0 and replayed > 0 else 1.0

    def _seconds(self, replay: Session) -> tuple[float, float]:
        """Return the time from first to last row of all runs, recorded and replayed [s]."""
        recorded = sum(span(self._source, self._names, run) for run in self._start_ns)
        replayed = sum(span(replay, self._names, number) for number in range(len(self._start_ns)))
        return recorded, replayed

    def _stopped(self, stop: BaseException) -> int:
        out = self._request.out
        print(f"stopped ({str(stop) or type(stop).__name__}); readable at {out}", file=sys.stderr)
        if isinstance(stop, Interrupted | KeyboardInterrupt):
            return EXIT_INTERRUPTED
        if isinstance(stop, DeviceLost | SessionError | OSError):
            return EXIT_DEVICE_LOST
        raise stop

    def _report(self) -> int:
        request, names = self._request, self._names
        replay = Session(request.out)
        again = _digests("images compared", replay, names)
        rows = {name: len(replay.streams[name]) for name in names}
        equal, lines = compared(self._hashes, again, rows)
        recorded, took = self._seconds(replay)
        lines.append(
            f"{recorded:.1f} s recorded, replayed in {took:.1f} s "
            f"({recorded / took if took > 0 else 1.0:.1f} times as fast)"
        )
        if request.speed > 0:
            for name in names:
                error = timing(self._source, replay, name, self._maps)
                if error is not None:
                    lines.append(timing_line(name, error))
        outcome = "equal" if equal else "DIFFERENT"
        lines.append(f"{outcome}: {request.source} and its replay; readable at {request.out}")
        print("\n".join(lines), flush=True)
        return EXIT_DONE if equal else EXIT_DIFFERENT


def _no_contact(source: Session, replay: Session, row: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of a row of `reference` that come from streams, as the replay has them.

    A stream that is left out moves the columns of those after it.
    """
    values: dict[str, Any] = {}
    for name, column in replay.reference.items():
        if name not in ("point", "run", "t_ns"):
            blank = np.full(column.shape[1:], np.nan) if column.ndim > 1 else -1
            values[name] = row.get(name, blank) if column.ndim > 1 else blank
    for name, column_name in replay.columns.items():
        for suffix in ("", "_std"):
            if column_name + suffix in values:
                values[column_name + suffix] = row[source.columns[name] + suffix]
    return values


def _rows(table: Any) -> list[dict[str, Any]]:
    names = list(table)
    count = len(table[names[0]])
    return [{name: table[name][row] for name in names} for row in range(count)]


def _digests(title: str, session: Session, names: tuple[str, ...]) -> dict[str, str]:
    with ItemProgress(title, sys.stderr) as progress:
        return {name: stream_digest(session.streams[name], progress) for name in names}


# One run: emulators and drivers, from the first connection to the last row.

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
        self._progress: dict[str, tuple[int, int]] = {}
        self._changed_ns: dict[str, int] = {}

    def reached(
        self, now_ns: int, arrived: Mapping[str, int], positions: Mapping[str, np.void | None]
    ) -> bool:
        """Return True if all rows of all streams have arrived.

        `arrived` are the rows received by each stream's process, `positions` the POSITION of each
        emulator.
        """
        for name, total in self._totals.items():
            if arrived[name] > total:
                raise DeviceLost(f"{name}: {arrived[name] - total} rows more than were sent")
        if all(arrived[name] == total for name, total in self._totals.items()):
            return True
        moving = False
        for name in self._totals:
            position = positions[name]
            sent = 0 if position is None else int(position["sent"])
            if self._progress.get(name) != (sent, arrived[name]) or name not in self._changed_ns:
                self._progress[name] = (sent, arrived[name])
                self._changed_ns[name] = now_ns
                moving = True
        for name, total in self._totals.items():
            position = positions[name]
            still = (now_ns - self._changed_ns[name]) / SECOND_NS
            ended = position is not None and position["state"] == ENDED
            missing = total - arrived[name]
            if missing and ended and still > MISSING_TIMEOUT:
                raise DeviceLost(
                    f"{name}: {missing} of {total} rows are missing {still:.0f} s after its "
                    "emulator had sent all"
                )
        stalled = (now_ns - max(self._changed_ns.values())) / SECOND_NS
        if not moving and stalled > STALL_TIMEOUT + self._gap:
            left = {name: total - arrived[name] for name, total in self._totals.items()}
            raise DeviceLost(f"replay: no progress for {stalled:.0f} s; rows missing: {left}")
        return False


# Samples that a driver delivers before playback starts, because it needs them to open, by kind.
_LEAD_IN = {"force": 1, "taxels": 1, "gripper": 1, "pose": 0, "arm_wrench": 0, "camera": 0}
_SETTLE_NS = SECOND_NS // 5
_SETTLE_TIMEOUT = 10.0
# Time from the cue to the start of playback; emulators poll the cue 200 times per second.
_LEAD_NS = SECOND_NS // 10
_LOOK_NS = SECOND_NS // 50
_SAY_NS = 5 * SECOND_NS


class ReplayedRun:
    """Context manager for the emulators and streams of one run, with an empty run folder.

    `bench` has the addresses of the emulators, on the loopback address of each stream in `hosts`;
    speed 0 is as fast as the drivers read.
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
        interrupt: InterruptFlag,
        *,
        speed: float,
    ) -> None:
        self._interrupt = interrupt
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
            self._source.path, self._names, self._run, self._hosts, self._folder, speed=self._speed
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

    def open(self) -> dict[str, dict[str, Any]]:
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
                self._interrupt.check()
                description[name] = self._handles[name].wait_opened()
        for name, handle in self._handles.items():
            if self._kinds[name] == "force":
                handle.set_bias(force_bias(self._source.streams[name]))
        self._settle()
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

    def watch(self) -> None:
        """Wait until every stream has all its rows."""
        players = self._started()
        end = EndOfTape(self.totals, self._gap)
        start_ns = said_ns = self._clock.now_ns()
        while True:
            self._interrupt.check()
            for handle in self._handles.values():
                handle.check()
            players.check()
            arrived = {
                name: record.count - self._base[name] for name, record in self._latest.items()
            }
            now_ns = self._clock.now_ns()
            if end.reached(now_ns, arrived, players.positions()):
                return
            if now_ns - said_ns >= _SAY_NS:
                said_ns = now_ns
                self._say(arrived, (now_ns - start_ns) / SECOND_NS)
            self._clock.sleep_until(now_ns + _LOOK_NS)

    def _settle(self) -> None:
        """Wait until the samples that the drivers needed to open have passed; they hold no row."""
        begun_ns = changed_ns = self._clock.now_ns()
        before: dict[str, int] = {}
        while True:
            self._interrupt.check()
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

    def _say(self, arrived: dict[str, int], seconds: float) -> None:
        total = sum(self.totals.values())
        done = sum(arrived.values()) / total if total else 1.0
        left = seconds * (1 - done) / done if done > 0 else self.seconds
        rows = "  ".join(f"{name} {arrived[name]}/{self.totals[name]}" for name in self._names)
        logger.info("replay %3.0f %%  %s  %s left", 100 * done, rows, duration(left))

    def _started(self) -> Players:
        if self._players is None:
            raise DeviceLost("replay: its emulators are not running")
        return self._players
