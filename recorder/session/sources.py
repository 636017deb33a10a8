"""Streams of one run, ready to be aligned: all of it, or what a window near some ticks needs.

Rows are in the order of their arrival, so a binary search over a stream's chunks finds those near a
time; only chunks near it are read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from recorder.session import align
from recorder.session.align import NS, Source, Sources, Times
from recorder.session.columns import Stream, StreamPart
from recorder.session.loss import Losses
from recorder.spec import frame_columns, signal_of


@dataclass(frozen=True, slots=True)
class RunStreams:
    """The streams of a session, and what of them belongs to one run."""

    streams: Mapping[str, Stream]
    """Streams by name, in the session's order."""
    rows: Mapping[str, slice]
    """Rows of each that belong to the run."""
    losses: Callable[[str], Losses]
    """Returns the losses in these rows of a stream."""

    @property
    def columns(self) -> dict[str, str]:
        """Column of `frames` by stream, of those that are aligned."""
        return frame_columns((name, stream.traits) for name, stream in self.streams.items())

    @property
    def signal(self) -> str | None:
        """Name of the stream that the others are aligned to."""
        return signal_of((name, stream.traits) for name, stream in self.streams.items())

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
