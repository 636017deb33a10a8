"""The streams of one run as alignment needs them: capture times and values in memory."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from recorder.align import NS, Times, Values

Array = np.ndarray[Any, Any]

EXPOSURE = 1 / 60
"""Exposure of a camera that does not state it [s]."""
_MAX_AGE = {"force": 0.02, "pose": 0.02}
_MAX_AGE_PERIODS = 2.0


@dataclass(frozen=True, slots=True)
class Source:
    """One stream of one run."""

    times: Times
    """Capture times (m,) [ns], ascending."""
    rows: NDArray[np.int64]
    """Row of the stream that each is (m,)."""
    values: Values | None
    """Values (m, ...); None for images, which stay on disk."""
    max_age: float
    """Oldest value that is still valid [s]."""
    exposure: float
    """Time the light was collected before a capture [s]."""


@dataclass(frozen=True, slots=True)
class Sources:
    """What a run has recorded; None for a stream the session lacks."""

    camera: Source | None
    force: Source | None
    pose: Source | None
    taxels: Source | None

    @property
    def signal(self) -> Source | None:
        """The stream that the others are aligned to: the camera, or else the taxels."""
        return self.camera or self.taxels

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last capture time of any stream [ns]; None without samples."""
        times = [
            source.times
            for source in (self.camera, self.force, self.pose, self.taxels)
            if source is not None and len(source.times)
        ]
        if not times:
            return None
        return min(int(t[0]) for t in times), max(int(t[-1]) for t in times)


class StreamLike(Protocol):
    """What is asked of a stream."""

    name: str
    attrs: dict[str, Any]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        ...

    @property
    def rate_hz(self) -> float:
        """Nominal rate."""
        ...

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Arrival times (n,) [ns]."""
        ...

    def array(self, name: str) -> Array:
        """Return a small column (n, ...)."""
        ...

    def values(self, rows: slice) -> Values:
        """Return rows of the column `value` (n, ...), or what is indexed like them."""
        ...


def sources_of_run(streams: Mapping[str, StreamLike], rows: Mapping[str, slice]) -> Sources:
    """Return the known streams of one run.

    Args:
        streams: Streams by name; those of other names are left out.
        rows: Rows of each that belong to the run.
    """
    found = {
        name: source(streams[name], rows[name]) if name in streams else None
        for name in ("camera", "force", "pose", "taxels")
    }
    return Sources(**found)


def source(stream: StreamLike, rows: slice) -> Source:
    """Return some rows of a stream with the times at which they were captured."""
    times = captured(stream)[rows]
    numbers = np.arange(len(stream.t_ns), dtype=np.int64)[rows]
    values = None if stream.name == "camera" else stream.values(rows)
    if np.any(np.diff(times) < 0):
        order = np.argsort(times, kind="stable")
        times, numbers = times[order], numbers[order]
        values = None if values is None else values[order]
    max_age = _MAX_AGE.get(stream.name, _MAX_AGE_PERIODS / stream.rate_hz)
    return Source(
        times,
        numbers,
        values,
        _number(stream, "max_age", max_age),
        _number(stream, "exposure", EXPOSURE),
    )


def captured(stream: StreamLike) -> Times:
    """Return when each row was true (n,) [ns], as far as the stream tells.

    Arrival minus attrs `latency` [s]; or the device's own time, where attrs `device_clock` is
    `monotonic`, because then it is the same clock (V4L2).
    """
    arrived = stream.t_ns - round(_number(stream, "latency", 0.0) / NS)
    if stream.attrs.get("device_clock") != "monotonic" or "device_t" not in stream.names:
        return arrived
    device_t = stream.array("device_t")
    known = np.isfinite(device_t)
    stamped = np.round(np.where(known, device_t, 0.0) / NS).astype(np.int64)
    return np.where(known, stamped, arrived)


def _number(stream: StreamLike, key: str, default: float) -> float:
    """Return an attribute that may be missing, or null because nobody knows it."""
    value = stream.attrs.get(key)
    return default if value is None else float(value)
