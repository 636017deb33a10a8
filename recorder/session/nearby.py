"""Streams of one run near a time: what a window needs, without the rest of the session.

Rows are in the order of their arrival, so a binary search over a stream's chunks finds those near a
time; only chunks near it are read.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recorder.session import align
from recorder.session.align import NS, Source, Sources, Times, Values
from recorder.spec import Column, frame_columns, signal_of

if TYPE_CHECKING:
    from recorder.session.reader import Session, Stream

Array = np.ndarray[Any, Any]


def sources_near(session: Session, run: int, ticks: Times) -> Sources:
    """Return the streams of a run as far as they are needed to align them at ascending ticks.

    The aligned values are those of `Session.sources`.
    """
    described = [(name, session.streams[name].traits) for name in session.order]
    columns, name = frame_columns(described), signal_of(described)
    start, stop = int(ticks[0]), int(ticks[-1])
    found = {}
    signal = None
    if name is not None:
        signal = found[name] = _near(session, name, run, start, stop)
        if len(signal.times):
            # Captures of the samples that are latest at, or nearest to, the ticks.
            first, last = np.searchsorted(signal.times, (start, stop), side="right")
            start = min(start, int(signal.times[max(first - 1, 0)]))
            stop = max(stop, int(signal.times[min(last, len(signal.times) - 1)]))
        start -= round(signal.exposure / NS)
    for other in columns:
        if other not in found:
            found[other] = _near(session, other, run, start, stop)
    return Sources({key: found[key] for key in columns}, columns, signal)


def span_of_run(session: Session, run: int) -> tuple[int, int] | None:
    """Return the first and last capture time of any stream with a role [ns]; None if empty."""
    spans = []
    for name in session.columns:
        stream, rows = session.streams[name], session.rows_of_run(name, run)
        if not stream.traits.roles or rows.stop <= rows.start:
            continue
        if _has_device_times(stream):
            times = np.sort(align.captured(_Part(stream, rows.start, rows.stop)))
        else:
            ends = (rows.start, rows.stop - 1)
            times = np.concatenate([align.captured(_Part(stream, k, k + 1)) for k in ends])
        spans.append((int(times[0]), int(times[-1])))
    if not spans:
        return None
    return min(first for first, _ in spans), max(last for _, last in spans)


class _Part:
    """Some rows of a stream, as alignment reads them."""

    def __init__(self, stream: Stream, first: int, last: int) -> None:
        self.name, self.attrs, self.traits = stream.name, stream.attrs, stream.traits
        self.names = stream.names
        self.rate_hz = stream.rate_hz
        self.value_column: Column | None = stream.value_column
        self._stream, self._first, self._last = stream, first, last

    def __len__(self) -> int:
        return self._last - self._first

    @cached_property
    def t_ns(self) -> NDArray[np.int64]:
        return self.array(self._stream.layout.time.column.name)

    def array(self, name: str) -> Array:
        return self._stream.rows_between(name, self._first, self._last)

    def values(self, rows: slice) -> Values:
        return self.array("value")[rows]


class Arrivals:
    """Arrival times of one run's rows, searched by chunk and read one chunk at a time."""

    def __init__(self, stream: Stream, first: int, last: int) -> None:
        """Search rows [first, last) of a stream."""
        self._stream = stream
        self.first, self.last = first, last
        self._known: list[tuple[int, int]] = []
        self.ordered = True

    def chunk(self, t_ns: int) -> int:
        """Return the number of the chunk whose first row is the last that arrived by a time.

        If all rows arrived later, this is the first chunk of the run.
        """
        block = self._stream.layout.block
        chunks = range(self.first // block, -(-self.last // block))
        return chunks[max(bisect_right(chunks, t_ns, key=self._start) - 1, 0)]

    def _start(self, chunk: int) -> int:
        row = max(chunk * self._stream.layout.block, self.first)
        place = bisect_right(self._known, (row, -1))
        if place < len(self._known) and self._known[place][0] == row:
            return self._known[place][1]
        time = int(self._stream.rows_between(self._stream.layout.time.column.name, row, row + 1)[0])
        before = self._known[place - 1][1] if place else time
        after = self._known[place][1] if place < len(self._known) else time
        self.ordered &= before <= time <= after
        insort(self._known, (row, time))
        return time


def _near(session: Session, name: str, run: int, start: int, stop: int) -> Source:
    """Return a stream's samples from before `start` to behind `stop`, as far as the run has them.

    In a stream whose times are not in order, these are all samples of the run.
    """
    stream, rows = session.streams[name], session.rows_of_run(name, run)
    first, last, block = rows.start, rows.stop, stream.layout.block
    if _has_device_times(stream) or last - first <= 2 * block:
        return _source(session, name, run, first, last)
    arrivals = stream.arrivals(first, last)
    late = round(float(stream.attrs.get("latency") or 0.0) / NS)
    low, high = arrivals.chunk(start + late), arrivals.chunk(stop + late) + 1
    reach = 1
    while True:
        part = _source(session, name, run, max(low * block, first), min(high * block, last))
        if not arrivals.ordered or np.any(np.diff(part.rows) < 0):
            return _source(session, name, run, first, last)
        before = low * block > first and not (len(part.times) and part.times[0] < start)
        after = high * block < last and not (len(part.times) and part.times[-1] > stop)
        if not before and not after:
            return part
        low, high = low - reach * before, high + reach * after
        low, reach = max(low, first // block), 2 * reach


def _source(session: Session, name: str, run: int, first: int, last: int) -> Source:
    stream, rows = session.streams[name], session.rows_of_run(name, run)
    losses = session.losses(name, run).part(first - (rows.start or 0), last - first)
    source = align.source(_Part(stream, first, last), slice(None), losses)
    return replace(source, rows=source.rows + first)


def _has_device_times(stream: Stream) -> bool:
    """Return True if samples are not aligned by the time of their arrival."""
    return stream.traits.clock == "monotonic" and "device_t" in stream.names
