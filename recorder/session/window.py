"""Synchronised rows at given ticks, used by both `frames` and `Session.window`.

Each tick gets the latest sample of the signal. All other values are aligned to the capture time of
that sample, because a label must match its image, not the tick.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session import align
from recorder.session.align import NS, Aligned, Bools, Floats, Picked, Source, Sources, Times
from recorder.session.columns import Stream, StreamPart
from recorder.session.loss import Losses, stream_losses
from recorder.spec import Traits, frame_columns, signal_of

# Streams of one run, ready to be aligned: all of it, or what a window near some ticks needs.
#
# Rows are in the order of their arrival, so a binary search over a stream's chunks finds those near
# a time; only chunks near it are read.


@dataclass(frozen=True, slots=True)
class RunStreams:
    """The streams of a session, and what of them belongs to one run."""

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
        source = align.source(StreamPart(self.streams[name], first, last), slice(None), losses)
        return replace(source, rows=source.rows + first)


def sources_of_run(run: RunStreams) -> Sources:
    """Return the streams of a run that are aligned."""
    sources = {
        name: align.source(run.streams[name], run.rows[name], run.losses(name))
        for name in run.columns
    }
    return Sources(sources, run.columns, None if run.signal is None else sources[run.signal])


def sources_near(run: RunStreams, ticks: Times) -> Sources:
    """Return the streams of a run as far as they are needed to align them at ascending ticks.

    The aligned values are those of `sources_of_run`.
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
        if _has_device_times(stream):
            times = np.sort(align.captured(StreamPart(stream, rows.start, rows.stop)))
        else:
            ends = (rows.start, rows.stop - 1)
            times = np.concatenate([align.captured(StreamPart(stream, k, k + 1)) for k in ends])
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
    if _has_device_times(stream) or last - first <= 2 * block:
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


def _has_device_times(stream: Stream) -> bool:
    """Return True if samples are not aligned by the time of their arrival."""
    return stream.traits.clock == "monotonic" and "device_t" in stream.names


# Rows of a window.


@dataclass(frozen=True, slots=True)
class AlignedStream:
    """One stream in the rows of a window."""

    traits: Traits
    """Kind, alignment, roles and clock of the stream."""
    value: NDArray[Any] | None
    """Values (n, ...), NaN where there is none; images (n, h, w, channels), zeros where there is
    none; None for images that were not loaded, and for text."""
    row: NDArray[np.int64] | None
    """Rows of the samples (n,), -1 where there is none; None for computed values."""
    age: Floats
    """Distance from the capture to the nearest sample used (n,) [s]; for the signal, tick minus
    capture; NaN where there is none."""
    valid: Bools
    """True if all samples used are near enough, and none that was needed is lost (n,)."""


@dataclass(frozen=True, slots=True)
class Window:
    """`n` synchronised rows. Rows before the start of a run or after its end are invalid.

    The values of the first stream of each kind are fields (`image`, `wrench`, `pose`, `taxels`),
    which are None if the session has no such stream; `of("wrench")` has its ages and validity.
    """

    t_ns: Times
    """Ticks (n,) [ns], one period apart, on the clock of the run."""
    capture_ns: Times
    """Capture time of each row's signal (n,) [ns]; the tick itself if there is none."""
    signal: str | None
    """Name of the signal; None in a session without one."""
    signal_row: NDArray[np.int64]
    """Row of the signal (n,); -1 if there is none."""
    streams: Mapping[str, AlignedStream]
    """All aligned streams, by name."""
    columns: Mapping[str, str]
    """Column of `frames` by stream."""

    def of(self, column: str) -> AlignedStream | None:
        """Return the stream of a column of `frames`, e.g. `wrench`; None if there is none."""
        names = (name for name, of_stream in self.columns.items() if of_stream == column)
        return next((self.streams[name] for name in names), None)

    @property
    def image(self) -> NDArray[Any] | None:
        """Images of the first camera (n, h, w, channels) RGB; zeros if there is none."""
        return _value(self.of("image"))

    @property
    def wrench(self) -> Floats | None:
        """Force and torque of the first gauge at the capture (n, 6) [N, N m], as in its stream."""
        return _value(self.of("wrench"))

    @property
    def pose(self) -> Floats | None:
        """First tool pose at the capture (n, 6) [m, rad], base frame, rotation vector."""
        return _value(self.of("pose"))

    @property
    def taxels(self) -> Floats | None:
        """Counts of the first taxels (n, 16, 3): at the capture, or the signal itself."""
        return _value(self.of("taxels"))

    @property
    def valid(self) -> Bools:
        """True if all streams that have a role are valid (n,)."""
        out = np.ones(len(self.t_ns), np.bool_)
        for stream in self.streams.values():
            if stream.traits.roles:
                out &= stream.valid
        return out

    @property
    def skew(self) -> Floats:
        """Largest distance of a value from the capture that it belongs to (n,) [s]; NaN if none."""
        known = [
            np.abs(stream.age)
            for name, stream in self.streams.items()
            if stream.traits.roles and name != self.signal
        ]
        if not known:
            return np.full(len(self.t_ns), np.nan)
        worst: Floats = np.fmax.reduce(known)
        return worst


def ticks_before(t_ns: int, n: int, rate_hz: float) -> Times:
    """Return `n` ticks (n,) [ns], the last at `t_ns`, one period apart."""
    back = np.arange(n - 1, -1, -1)
    return t_ns - np.round(back * (1e9 / rate_hz)).astype(np.int64)


def align_window(
    ticks: Times, sources: Sources, methods: Mapping[str, str] | None = None
) -> Window:
    """Return the synchronised rows at ascending `ticks` (n,) [ns], without the images' pixels.

    `methods` are by stream, in place of its own alignment.
    """
    methods = methods or {}
    for name in methods:
        if name not in sources.streams:
            raise SessionError(f"align: no stream {name!r}; known: {', '.join(sources.streams)}")
    chosen = {
        name: _method(source, methods.get(name, source.traits.align))
        for name, source in sources.streams.items()
    }
    signal = sources.signal
    capture, rows = ticks, np.full(len(ticks), -1, np.int64)
    picked: Picked | None = None
    exposure = 0.0
    if signal is not None:
        # The signal is a sample, so a method that computes values takes the latest one.
        pick = align.nearest if chosen[signal.name] == "nearest" else align.held
        picked = pick(signal.times, ticks, max_age=signal.max_age)
        some = picked.index >= 0
        capture, exposure = ticks.copy(), signal.exposure
        capture[some] = signal.times[picked.index[some]]
        rows[some] = signal.rows[picked.index[some]]
    streams = {
        name: _taken(source, picked, ticks)
        if source is signal and picked is not None
        else _aligned(source, chosen[name], capture, exposure)
        for name, source in sources.streams.items()
    }
    return Window(
        t_ns=ticks,
        capture_ns=capture,
        signal=None if signal is None else signal.name,
        signal_row=rows,
        streams=streams,
        columns=sources.columns,
    )


def _method(source: Source, method: str) -> str:
    known = ["latest", "nearest"]
    if source.values is not None:
        known += ["interpolated", *([] if source.is_pose else ["mean"])]
    if method not in known:
        raise SessionError(f"{source.name}: found method {method!r}; known: {', '.join(known)}")
    return method


def _aligned(source: Source, method: str, capture: Times, exposure: float) -> AlignedStream:
    if source.values is None or method in ("latest", "nearest"):
        pick = align.nearest if method == "nearest" else align.held
        return _taken(source, pick(source.times, capture, max_age=source.max_age), capture)
    found: Aligned
    if method == "mean":
        start, stop = capture - round(exposure / NS), capture
        found = align.mean(source.times, source.values, start, stop, max_age=source.max_age)
        lost = source.losses.touch(start, stop)
    else:
        interpolate = align.pose if source.is_pose else align.linear
        found = interpolate(source.times, source.values, capture, max_age=source.max_age)
        lost = source.losses.around(capture)
    return AlignedStream(source.traits, found.value, None, found.age, found.valid & ~lost)


def _taken(source: Source, picked: Picked, moments: Times) -> AlignedStream:
    """Return unmodified samples: their values, or only their rows for images and text.

    A sample is not valid if one nearer to its moment was lost.
    """
    some = picked.index >= 0
    rows = np.full(len(picked.index), -1, np.int64)
    rows[some] = source.rows[picked.index[some]]
    value = None
    if source.values is not None:
        value = np.full((len(rows), *source.values.shape[1:]), np.nan)
        value[some] = source.values[picked.index[some]]
    taken = moments.copy()
    taken[some] = source.times[picked.index[some]]
    lost = source.losses.touch(np.minimum(taken, moments), np.maximum(taken, moments))
    return AlignedStream(source.traits, value, rows, picked.age, picked.valid & ~lost)


def _value(stream: AlignedStream | None) -> NDArray[Any] | None:
    return None if stream is None else stream.value
