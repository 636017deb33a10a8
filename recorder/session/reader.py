"""Read-only access to a session. Takes no lock, changes nothing and never fills in values."""

import operator
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.align import (
    NS,
    Source,
    Sources,
    Times,
    Window,
    align_window,
    captured,
    has_device_times,
    source,
)
from recorder.session.columns import Stream, StreamPart, StreamTable
from recorder.session.loss import Account, Losses, account_of, is_compressed, stream_losses
from recorder.spec import frame_columns, signal_of
from recorder.store.documents import read_order, read_session_attrs
from recorder.store.files import locate
from recorder.store.manifest import sealed_files
from recorder.store.reader import Table

Array = np.ndarray[Any, Any]


# Streams of one run, ready to be aligned: all of it, or what a window near some ticks needs.
#
# Rows are in the order of their arrival, so a binary search over a stream's chunks finds those near
# a time; only chunks near it are read.


@dataclass(frozen=True, slots=True)
class RunStreams:
    """The streams of a session, restricted to the samples of one run."""

    streams: Mapping[str, Stream]
    """Streams by name, in the session's order."""
    rows: Mapping[str, slice]
    """Rows of each that belong to the run."""
    timed: bool
    """True if missing samples show in the times of a stream."""
    counted: dict[str, Losses]
    """Losses that were counted so far, by stream; kept in memory."""

    def losses(self, name: str) -> Losses:
        """Return the samples that a stream lost in these rows."""
        if name not in self.counted:
            losses = stream_losses(self.streams[name], self.rows[name], timed=self.timed)
            self.counted[name] = losses
        return self.counted[name]

    @property
    def columns(self) -> dict[str, str]:
        """Column of `frames` by stream, of those that are aligned."""
        return frame_columns([(name, stream.traits) for name, stream in self.streams.items()])

    @property
    def signal(self) -> str | None:
        """Name of the stream that the others are aligned to."""
        return signal_of([(name, stream.traits) for name, stream in self.streams.items()])

    def part(self, name: str, first: int, last: int) -> Source:
        """Return rows [first, last) of a stream, numbered as in the stream."""
        losses = self.losses(name).part(first - (self.rows[name].start or 0), last - first)
        part = source(StreamPart(self.streams[name], first, last), slice(None), losses)
        return replace(part, rows=part.rows + first)


def sources_near(run: RunStreams, ticks: Times) -> Sources:
    """Return the streams of a run as far as they are needed to align them at ascending ticks.

    The aligned values are those of `Session.sources`.
    """
    start, stop = int(ticks[0]), int(ticks[-1])
    sources: dict[str, Source] = {}
    signal = None
    if run.signal is not None:
        signal = sources[run.signal] = _near(run, run.signal, start, stop)
        if len(signal.times):
            # Captures of the samples that are latest at, or nearest to, the ticks.
            first, last = np.searchsorted(signal.times, (start, stop), side="right")
            start = min(start, int(signal.times[max(first - 1, 0)]))
            stop = max(stop, int(signal.times[min(last, len(signal.times) - 1)]))
        start -= round(signal.exposure / NS)
    for name in run.columns:
        if name not in sources:
            sources[name] = _near(run, name, start, stop)
    return Sources({name: sources[name] for name in run.columns}, run.columns, signal)


def span_of_run(run: RunStreams) -> tuple[int, int] | None:
    """Return the first and last capture time of any stream with a role [ns]; None if empty."""
    spans = []
    for name in run.columns:
        stream, rows = run.streams[name], run.rows[name]
        if not stream.traits.roles or rows.stop <= rows.start:
            continue
        if has_device_times(stream):
            times = np.sort(captured(StreamPart(stream, rows.start, rows.stop)))
        else:
            ends = (rows.start, rows.stop - 1)
            times = np.concatenate([captured(StreamPart(stream, k, k + 1)) for k in ends])
        spans.append((int(times[0]), int(times[-1])))
    if not spans:
        return None
    return min(first for first, _ in spans), max(last for _, last in spans)


def _near(run: RunStreams, name: str, start: int, stop: int) -> Source:
    """Return a stream's samples from before `start` to behind `stop`, as far as the run has them.

    In a stream whose times are not in order, these are all samples of the run.
    """
    stream, rows = run.streams[name], run.rows[name]
    first, last, block = rows.start, rows.stop, stream.layout.block
    if has_device_times(stream) or last - first <= 2 * block:
        return run.part(name, first, last)
    arrivals = stream.arrivals(first, last)
    late = round(float(stream.attrs.get("latency") or 0.0) / NS)
    low, high = arrivals.chunk(start + late), arrivals.chunk(stop + late) + 1
    reach = 1
    while True:
        part = run.part(name, max(low * block, first), min(high * block, last))
        if not arrivals.ordered or np.any(np.diff(part.rows) < 0):
            return run.part(name, first, last)
        before = low * block > first and not (len(part.times) and part.times[0] < start)
        after = high * block < last and not (len(part.times) and part.times[-1] > stop)
        if not before and not after:
            return part
        low, high = low - reach * before, high + reach * after
        low, reach = max(low, first // block), 2 * reach


# Most rows of `frames` in one phase: three days at 1 kHz.
TICKS_MAX = 1 << 28


class Session:
    """One recorded session, read-only.

    A session that is still being recorded, or whose writers were killed, shows all rows that are
    complete when it is opened, and has a `warning`; it has no `frames` yet.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        storage_options: Mapping[str, Any] | None = None,
        unsealed: bool = False,
    ) -> None:
        """Open a session.

        Args:
            path: A directory, or a URL that fsspec knows, such as `s3://bucket/x.zarr`.
            storage_options: Options that fsspec needs to open the URL, e.g. `{"anon": True}`.
            unsealed: True to read a closed session although a manifest is lost, with a `warning`;
                its chunks are verified by their checksums, its other files cannot be.
        """
        self.files, self.path = locate(path, storage_options)
        with self.files.remembering():
            self._open(unsealed)

    def _open(self, unsealed: bool) -> None:
        self.attrs = read_session_attrs(self.path, self.files)
        if self.status == "recording" and not self.files.local:
            raise SessionError(
                f"{self.name}: was copied while it was recorded; recover it where it was "
                "recorded (tactile session recover) and copy it again"
            )
        self.files, self._lost_manifest = sealed_files(
            self.files, self.path, self.attrs, unsealed=unsealed
        )
        self.attrs = read_session_attrs(self.path, self.files)
        live = self.status == "recording"
        groups = self.files.groups(self.path / "streams")
        self.streams: Mapping[str, Stream] = {
            group.name: Stream(group, self.files, live=live) for group in groups
        }
        declared = read_order(self.path / "streams", self.files)
        self.order = [name for name in declared if name in self.streams]
        self.order += sorted(self.streams.keys() - set(declared))
        self.targets = Table(self.path / "targets", self.files)
        self.segments = StreamTable(Stream(self.path / "segments", self.files, live=live))
        self.reference = StreamTable(Stream(self.path / "reference", self.files, live=live))
        self.frames = Table(self.path / "frames", self.files)
        self._losses: dict[int, dict[str, Losses]] = {}
        self._spans: dict[int, tuple[int, int] | None] = {}

    def __repr__(self) -> str:
        """Return its place, status, sensor, indenter and the rows of its streams."""
        labels = (self.attrs.get(key) for key in ("sensor", "indenter"))
        rows = ", ".join(f"{name} {len(stream):,}" for name, stream in self.streams.items())
        parts = [self.status, *(str(each) for each in labels if each), rows or "no streams"]
        return f"<Session {self.name}: {', '.join(parts)}>"

    def require_frames(self) -> Table:
        """Return `frames`.

        Raises:
            SessionError: The session has none, such as while it is recorded.
        """
        if "t_ns" not in self.frames:
            live = self.status == "recording"
            raise SessionError(
                f"{self.name}: {'recording, so it has no frames yet' if live else 'has no frames'} "
                "(tactile session recover builds them, once nothing writes to it)"
            )
        return self.frames

    @property
    def name(self) -> str:
        """Location of the session as a path or URL."""
        return self.files.name(self.path)

    @property
    def status(self) -> str:
        """One of `spec.STATUSES`."""
        return str(self.attrs["status"])

    @property
    def runs(self) -> list[dict[str, Any]]:
        """Entries of attrs `runs`, with the `first_row` of each stream."""
        return list(self.attrs["runs"])

    @property
    def warning(self) -> str | None:
        """Warning to show before the session is used, or None."""
        if self._lost_manifest is not None:
            return f"opened without its manifest: {self._lost_manifest}"
        if self.status == "recording":
            return (
                f"{self.name}: still recording, or killed while it was; its rows so far are "
                "visible, frames are not (tactile session recover, once nothing writes to it)"
            )
        return None

    @cached_property
    def rate_hz(self) -> float:
        """Rate of the frames view: attrs `rate_hz`, or else the signal's."""
        if "rate_hz" in self.attrs:
            return float(self.attrs["rate_hz"])
        for name in (self.signal, self.first("pose"), *self.order):
            if name is not None:
                return self.streams[name].rate_hz
        raise SessionError(f"{self.name}: no stream has a rate; set rate_hz")

    @cached_property
    def controls(self) -> dict[int, int]:
        """Rows of `targets` that repeat another one to compare them, and which row each repeats."""
        repeats = np.asarray(self.targets.get("control", ()))
        return {int(row): int(repeats[row]) for row in np.flatnonzero(repeats >= 0)}

    @property
    def plan_targets(self) -> dict[str, Array]:
        """Columns of `targets`, of the plan's own: without `controls`, which are the last rows."""
        last = -len(self.controls) or None
        return {name: values[:last] for name, values in self.targets.items()}

    @property
    def columns(self) -> dict[str, str]:
        """Column of `frames` and `reference` by stream, in order; see `spec.frame_columns`."""
        return frame_columns([(name, self.streams[name].traits) for name in self.order])

    @property
    def signal(self) -> str | None:
        """Name of the stream that the others are aligned to; None without a signal."""
        return signal_of([(name, self.streams[name].traits) for name in self.order])

    def of_kind(self, kind: str) -> list[str]:
        """Return the names of the streams of a kind, in order."""
        return [name for name in self.order if self.streams[name].traits.kind == kind]

    def first(self, kind: str) -> str | None:
        """Return the name of the first stream of a kind; None if there is none."""
        return next(iter(self.of_kind(kind)), None)

    def setting(self, *keys: str) -> dict[str, Any]:
        """Return a mapping of the attributes, such as that of `bench`, `arm`; empty without it."""
        entry: Any = self.attrs
        for key in keys:
            entry = entry.get(key)
            if not isinstance(entry, dict):
                return {}
        return dict(entry)

    def rows_of_run(self, name: str, run: int) -> slice:
        """Return the rows of a stream that belong to a run.

        Raises:
            SessionError: No such run.
        """
        if not 0 <= run < max(len(self.runs), 1):
            raise SessionError(f"{self.name}: no run {run}; runs: {len(self.runs)}")
        length = len(self.streams[name])
        first = [int(entry["first_row"].get(name, 0)) for entry in self.runs]
        if not first:
            return slice(0, length)
        return slice(first[run], first[run + 1] if run + 1 < len(first) else length)

    def run_streams(self, run: int) -> RunStreams:
        """Return the streams in order, with their rows and losses of one run."""
        rows = {name: self.rows_of_run(name, run) for name in self.order}
        streams = {name: self.streams[name] for name in self.order}
        counted = self._losses.setdefault(run, {})
        return RunStreams(streams, rows, not is_compressed(self.attrs), counted)

    def sources(self, run: int) -> Sources:
        """Return the streams of one run, ready to be aligned."""
        of = self.run_streams(run)
        sources = {
            name: source(of.streams[name], of.rows[name], of.losses(name)) for name in of.columns
        }
        return Sources(sources, of.columns, None if of.signal is None else sources[of.signal])

    def losses(self, name: str, run: int) -> Losses:
        """Return the samples that a stream lost in a run; kept in memory."""
        return self.run_streams(run).losses(name)

    def account(self, name: str) -> Account:
        """Return the samples of a stream that the session has, and those that it lost.

        Raises:
            SessionError: A corrupt column.
        """
        runs = range(max(len(self.runs), 1))
        losses = [self.losses(name, run) for run in runs]
        by_target = Counter[int]()
        for run, lost in enumerate(losses):
            by_target += self._lost_by_target(lost, run)
        rows = [self.rows_of_run(name, run) for run in runs]
        return account_of(self.streams[name], rows, losses, dict(sorted(by_target.items())))

    def _lost_by_target(self, losses: Losses, run: int) -> Counter[int]:
        """Return the samples lost in a run, by the target in whose phases they were lost."""
        segments = self.segments
        of_run = np.flatnonzero(np.asarray(segments["run"]) == run)
        lost = Counter[int]()
        if losses.total and len(of_run):
            inside = losses.inside(segments["start_ns"][of_run], segments["end_ns"][of_run])
            targets = segments["target"][of_run].tolist()
            for target, count in zip(targets, inside.tolist(), strict=True):
                lost[target] += count
        return +lost

    def run_ticks(self, rate_hz: float) -> Iterator[tuple[int, Times, NDArray[np.int64]]]:
        """Yield each run with its ticks and the segment of each tick; none of a control press."""
        segments = self.segments
        # Sessions made elsewhere may have no targets; a table with corrupt chunks still has them.
        if not any(self.targets.declared_rows(name) for name in self.targets):
            for run in range(max(len(self.runs), 1)):
                ticks = np.zeros(0, np.int64)
                if span := span_of_run(self.run_streams(run)):
                    ticks = grid(span[0], span[0], span[1] + 1, rate_hz)
                yield run, ticks, np.full(len(ticks), -1, np.int64)
            return
        planned = ~np.isin(segments["target"], list(self.controls))
        for run in np.unique(segments["run"][planned]):
            of_run = np.flatnonzero(planned & (segments["run"] == run))
            of_run = of_run[np.argsort(segments["start_ns"][of_run], kind="stable")]
            starts, ends = segments["start_ns"][of_run], segments["end_ns"][of_run]
            anchor = int(starts[0])
            parts = [
                grid(anchor, int(start), int(end), rate_hz)
                for start, end in zip(starts, ends, strict=True)
            ]
            lengths = [len(part) for part in parts]
            yield int(run), np.concatenate(parts), np.repeat(of_run, lengths)

    def run_at(self, t_ns: int) -> int:
        """Return the latest run whose samples enclose a time, or else the last run."""
        count = max(len(self.runs), 1)
        for run in reversed(range(count if count > 1 else 0)):
            if run not in self._spans:
                self._spans[run] = span_of_run(self.run_streams(run))
            span = self._spans[run]
            if span is not None and span[0] <= t_ns <= span[1]:
                return run
        return count - 1

    def window(
        self,
        t_ns: int | None = None,
        n: int = 1,
        *,
        row: int | None = None,
        align: Mapping[str, str] | None = None,
        rate_hz: float | None = None,
        run: int | None = None,
    ) -> Window:
        """Return `n` synchronised rows up to a time, as a live program would have seen them.

        Args:
            t_ns: Tick of the last row [ns]; the others lie before it, one period apart.
            n: Number of rows.
            row: Row of `frames` that is the last one, in place of `t_ns`; -1 is that at the end.
            align: Methods by stream in place of its own alignment: `latest` or `nearest`, of
                numbers also `interpolated`, and `mean` if they are no poses.
            rate_hz: Rate of the rows; the session's if None.
            run: Run of whose clock `t_ns` is; determined from the samples if None.

        Raises:
            SessionError: No samples at that time, an unknown stream or method, a corrupt stream.
        """
        if (t_ns is None) == (row is None):
            raise SessionError(f"window: found t_ns {t_ns}, row {row}; allowed: one of them")
        if row is not None:
            frames = self.require_frames()
            t_ns, run = frames["t_ns"][row], int(frames["run"][row])
        end = operator.index(t_ns or 0)
        ticks = ticks_before(end, operator.index(n), rate_hz or self.rate_hz)
        of_run = self.run_at(end) if run is None else run
        sources = sources_near(self.run_streams(of_run), ticks) if n > 0 else self.sources(of_run)
        rows = align_window(ticks, sources, align)
        if row is None and n > 0 and not rows.valid.any():
            self._require_samples(of_run, ticks)
        images = {
            name: replace(aligned, value=self._pixels(name, aligned.row))
            for name, aligned in rows.streams.items()
            if aligned.row is not None and self.streams[name].layout.image is not None
        }
        return replace(rows, streams={**rows.streams, **images})

    def _require_samples(self, run: int, ticks: Times) -> None:
        """Reject ticks that all lie outside of a run, such as the index of a row."""
        span = span_of_run(self.run_streams(run))
        if span is not None and not (ticks[0] <= span[1] and span[0] <= ticks[-1]):
            raise SessionError(
                f"t_ns: found {ticks[-1]}; run {run} has samples from {span[0]} to {span[1]} [ns]; "
                "allowed: such a time, or row=... for a row of frames"
            )

    def _pixels(self, name: str, rows: NDArray[np.int64]) -> Array:
        """Return the images of some rows (n, h, w, channels); zeros for row -1."""
        stream = self.streams[name]
        column = stream.layout.columns[0].column
        pixels = np.empty((len(rows), *column.shape), column.dtype)
        pixels[rows < 0] = 0
        stream.images_into(rows, pixels)
        return pixels


def accounts_of(session: Session) -> dict[str, Account]:
    """Return the account of every stream, by name.

    Raises:
        SessionError: A corrupt column.
    """
    return {name: session.account(name) for name in session.streams}


def ticks_before(t_ns: int, n: int, rate_hz: float) -> Times:
    """Return `n` ticks (n,) [ns], the last at `t_ns`, one period apart."""
    back = np.arange(n - 1, -1, -1)
    return t_ns - np.round(back * (1e9 / rate_hz)).astype(np.int64)


def grid(anchor: int, start: int, end: int, rate_hz: float) -> Times:
    """Return the ticks anchor + k / rate_hz with start <= tick < end (n,) [ns]."""
    period = 1e9 / rate_hz
    if (end - start) / period > TICKS_MAX:
        raise SessionError(
            f"found a phase of {(end - start) * 1e-9:.3g} s at {rate_hz:g} Hz; allowed: up to "
            f"{TICKS_MAX} rows of frames"
        )
    first = int((start - anchor) // period) - 1
    last = int((end - anchor) // period) + 2
    ticks = anchor + np.round(np.arange(first, last + 1) * period).astype(np.int64)
    return ticks[(ticks >= start) & (ticks < end)]
