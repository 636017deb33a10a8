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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder import Session, SessionError, SessionWriter, StreamWriter
from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE, EXIT_INTERRUPTED
from recorder.command_line.options import next_command
from recorder.info import session_digest, stream_digest
from recorder.progress import ItemProgress
from rig.acquire.collector import software
from rig.acquire.control import Interrupted, InterruptFlag
from rig.core.clock import ClockAnchor, SystemClock
from rig.core.errors import DeviceLost
from rig.mock.players import playback_hosts, replay_bench
from rig.replay.replayable import replayable
from rig.replay.result import Retiming, compared, covered_ns, retiming, span, timing, timing_line
from rig.replay.run import ReplayedRun

logger = logging.getLogger(__name__)

EXIT_DIFFERENT = 1
# Attributes of the source that also apply to the replay.
_COPIED = (
    *("sensor", "indenter", "operator", "plan", "targets_wanted", "bench", "contact_frame"),
    *("calibration", "imported", "mock_sources"),
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
        self._writer: SessionWriter | None = None
        self._maps: dict[int, Retiming] = {}
        self._start_ns: dict[int, int] = {}

    def run(self) -> int:
        """Replay and return the exit code; recorded data is closed and readable however it ends."""
        request, source = self._request, self._source
        if request.out.exists():
            raise SessionError(f"{request.out}: exists already; choose another name")
        with ItemProgress("images checked", sys.stderr) as progress:
            names = replayable(source, request.without, progress)
        hashes = _digests("images read", source, names)
        stop: BaseException | None = None
        with InterruptFlag() as interrupt:
            try:
                self._replay_runs(names, hashes, interrupt)
            except BaseException as error:
                # On any error, the session is closed before anything else.
                stop = error
            if self._writer is None:
                if stop is not None:
                    raise stop
                raise SessionError(f"{request.source}: no rows to replay")
            interrupt.ignore()
            try:
                self._finish(self._writer, names, stop)
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
        return self._report(names, hashes)

    def _replay_runs(
        self, names: tuple[str, ...], hashes: dict[str, str], interrupt: InterruptFlag
    ) -> None:
        request, source = self._request, self._source
        for run in range(max(len(source.runs), 1)):
            with contextlib.ExitStack() as stack:
                folder = Path(
                    stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-"))
                )
                hosts = playback_hosts(names)
                bench = replay_bench(source, names, hosts, request.speed)
                replayed = ReplayedRun(
                    source, names, run, bench, hosts, folder, self._clock, speed=request.speed
                )
                if not replayed.seconds and not any(replayed.totals.values()):
                    continue
                stack.enter_context(replayed)
                description = replayed.open(interrupt)
                if self._writer is None:
                    self._writer = self._create(names, hashes, description, replayed)
                self._writer.begin_run({**asdict(ClockAnchor.take()), "devices": description})
                for name in names:
                    replayed.record(name, self._writer.stream_path(name))
                self._start_ns[run] = replayed.start_playback()
                replayed.watch(interrupt)

    def _create(
        self,
        names: tuple[str, ...],
        hashes: dict[str, str],
        description: dict[str, Any],
        replayed: ReplayedRun,
    ) -> SessionWriter:
        source, request = self._source, self._request
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
                "sha256": session_digest(hashes),
                "streams": hashes,
                "left_out": sorted(set(source.streams) - set(names)),
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
        return SessionWriter.create(
            request.out,
            attrs={**{key: attrs[key] for key in _COPIED if key in attrs}, **own},
            streams=specs,
            targets=dict(source.targets),
        )

    def _finish(
        self, writer: SessionWriter, names: tuple[str, ...], stop: BaseException | None
    ) -> None:
        if stop is not None:
            for name in names:
                # A stream whose process was killed has rows that only a writer recovers.
                StreamWriter.open(writer.stream_path(name)).close()
        replay = Session(writer.path)
        runs = list(self._start_ns)
        for place, run in enumerate(runs):
            start_ns = self._start_ns[run]
            # A run without any row has no counterpart, so runs of the replay are renumbered.
            if place != run:
                logger.warning("run %d of the source is run %d of the replay", run, place)
            self._maps[run] = retiming(
                self._source, replay, names, run, start_ns, self._request.speed
            )
        covered = {run: covered_ns(replay, names, place) for place, run in enumerate(runs)}
        numbers = {run: place for place, run in enumerate(runs)}
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
        status, reason = "complete", ""
        if stop is not None:
            status, reason = "stopped", f"replay: {str(stop) or type(stop).__name__}"
        writer.finish(
            status,
            reason,
            rate_hz=self._source.rate_hz * self._faster(replay, names),
            # At another speed the devices' clocks are slower than the host's by that factor.
            clocks=self._request.speed == 1.0,
        )

    def _faster(self, replay: Session, names: tuple[str, ...]) -> float:
        """Return the playback speed relative to the recording."""
        if self._request.speed > 0:
            return self._request.speed
        recorded = sum(span(self._source, names, run) for run in self._start_ns)
        replayed = sum(span(replay, names, place) for place in range(len(self._start_ns)))
        return recorded / replayed if recorded > 0 and replayed > 0 else 1.0

    def _stopped(self, stop: BaseException) -> int:
        out = self._request.out
        print(f"stopped ({str(stop) or type(stop).__name__}); readable at {out}", file=sys.stderr)
        if isinstance(stop, Interrupted | KeyboardInterrupt):
            return EXIT_INTERRUPTED
        if isinstance(stop, DeviceLost | SessionError | OSError):
            return EXIT_DEVICE_LOST
        raise stop

    def _report(self, names: tuple[str, ...], hashes: dict[str, str]) -> int:
        request = self._request
        replay = Session(request.out)
        again = _digests("images compared", replay, names)
        rows = {name: len(replay.streams[name]) for name in names}
        equal, lines = compared(hashes, again, rows)
        recorded = sum(span(self._source, names, run) for run in self._start_ns)
        took = sum(span(replay, names, place) for place in range(len(self._start_ns)))
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
    for name, place in replay.columns.items():
        for suffix in ("", "_std"):
            if place + suffix in values:
                values[place + suffix] = row[source.columns[name] + suffix]
    return values


def _rows(table: Any) -> list[dict[str, Any]]:
    names = list(table)
    count = len(table[names[0]])
    return [{name: table[name][row] for name in names} for row in range(count)]


def _digests(title: str, session: Session, names: tuple[str, ...]) -> dict[str, str]:
    with ItemProgress(title, sys.stderr) as progress:
        return {name: stream_digest(session.streams[name], progress) for name in names}
