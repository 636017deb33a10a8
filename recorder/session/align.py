"""Align streams sampled at different rates to common times. Pure functions.

Times are int64 nanoseconds, sorted ascending; they are subtracted as integers before conversion
to float, since float64 cannot resolve nanoseconds in a time since boot. Every result has the
distance to the samples used (`age` [s]) and a flag `valid`: near enough. Nothing is extrapolated:
outside the samples a value is NaN and invalid.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.columns import Columns, Rows, blocks
from recorder.session.loss import Losses
from recorder.spec import AXES, STAMPS, Traits

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Array = np.ndarray[Any, Any]

NS = 1e-9


@dataclass(frozen=True, slots=True)
class Picked:
    """One unmodified sample per query."""

    index: NDArray[np.int64]
    """Sample used (n,); -1 where there is none."""
    age: Floats
    """Query minus sample (n,) [s]; negative for a later sample, NaN where there is none."""
    valid: Bools
    """True if the sample exists and is near enough (n,)."""


@dataclass(frozen=True, slots=True)
class Aligned:
    """One computed value per query."""

    value: Floats
    """Values (n, ...); NaN outside the samples."""
    age: Floats
    """Distance to the nearest sample used (n,) [s]; NaN outside the samples."""
    valid: Bools
    """True if all samples used are near enough (n,)."""


def held(times: Times, query: Times, *, max_age: float = np.inf) -> Picked:
    """Return the latest sample at or before each query; of equal times the last.

    Sample times (m,) [ns] ascend, queries are (n,) [ns]; a sample is valid up to an age of
    `max_age` [s].
    """
    index = np.searchsorted(times, query, side="right").astype(np.int64) - 1
    return _picked(times, query, index, max_age)


def nearest(times: Times, query: Times, *, max_age: float = np.inf) -> Picked:
    """Return the sample nearest to each query, at most `max_age` [s] away; the earlier of a tie."""
    if not len(times):
        return _picked(times, query, np.full(len(query), -1, np.int64), max_age)
    behind = np.searchsorted(times, query, side="right").astype(np.int64)
    before = np.maximum(behind - 1, 0)
    after = np.minimum(behind, len(times) - 1)
    nearer_before = np.abs(query - times[before]) <= np.abs(times[after] - query)
    chosen = np.where(nearer_before, times[before], times[after])
    index = np.searchsorted(times, chosen, side="right").astype(np.int64) - 1
    return _picked(times, query, index, max_age)


def linear(times: Times, values: Array, query: Times, *, max_age: float = np.inf) -> Aligned:
    """Return values (m, ...) interpolated linearly between the samples around each query.

    As for `held`; `max_age` is the largest distance of either sample that is valid [s].
    """
    bracket = _bracket(times, query, max_age)
    weight = bracket.weight.reshape(-1, *(1 for _ in values.shape[1:]))
    if len(times):
        # A plain sum of two products: exact on a sample, and NaN only if a sample used is NaN.
        first = np.where(weight < 1, values[bracket.before], 0) * (1 - weight)
        second = np.where(weight > 0, values[bracket.after], 0) * weight
        value = np.asarray(first + second, np.float64)
    else:
        value = np.empty((len(query), *values.shape[1:]))
    value[~bracket.inside] = np.nan
    return Aligned(value, bracket.age, bracket.valid)


def mean(
    times: Times, values: Array, start: Times, stop: Times, *, max_age: float = np.inf
) -> Aligned:
    """Return the mean of the samples (m, ...) inside each interval [start, stop], ends included.

    If no sample lies inside, the value is interpolated linearly at the middle of the interval. A
    mean is valid if samples lie within `max_age` [s] of both ends; its age is the time from its
    last sample to `stop`. Times are in [ns], those of samples ascending.
    """
    first = np.searchsorted(times, start, side="left")
    last = np.searchsorted(times, stop, side="right")
    some = last > first
    result = linear(times, values, start + (stop - start) // 2, max_age=max_age)
    if some.any():
        low, high = first[some], last[some]
        count = (high - low).reshape(-1, *(1 for _ in values.shape[1:]))
        result.value[some] = _sums(values, low, high) / count
        result.age[some] = (stop[some] - times[high - 1]) * NS
        lead = (times[low] - start[some]) * NS
        result.valid[some] = (result.age[some] <= max_age) & (lead <= max_age)
    return result


def pose(times: Times, poses: Array, query: Times, *, max_age: float = np.inf) -> Aligned:
    """Return poses: positions interpolated linearly, rotations along the shortest arc.

    As `linear`, of positions [m] and rotation vectors [rad] (m, 6).
    """
    result = linear(times, poses, query, max_age=max_age)
    bracket = _bracket(times, query, max_age)
    inside = bracket.inside
    if inside.any():
        first = quaternion(poses[bracket.before[inside], 3:])
        second = quaternion(poses[bracket.after[inside], 3:])
        result.value[inside, 3:] = rotation_vector(slerp(first, second, bracket.weight[inside]))
    return result


def quaternion(vector: Floats) -> Floats:
    """Return unit quaternions w x y z (n, 4) of rotation vectors (n, 3) [rad]."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    half = 0.5 * angle
    # sin(a/2)/a, through np.sinc so that it is also defined at a = 0.
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def rotation_vector(quat: Floats) -> Floats:
    """Return rotation vectors (n, 3) [rad] of unit quaternions w x y z (n, 4), angle 0 to pi."""
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quat[..., :1])
    scale = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0)
    return np.asarray(scale * quat[..., 1:])


def slerp(first: Floats, second: Floats, weight: Floats) -> Floats:
    """Return the rotations (n, 4) at `weight` (n,) on the shortest arc from `first` to `second`."""
    cosine = np.sum(first * second, axis=-1, keepdims=True)
    second = np.where(cosine < 0, -second, second)
    # The chord gives the angle precisely where the cosine is flat.
    chord = np.linalg.norm(second - first, axis=-1, keepdims=True)
    angle = 2.0 * np.arcsin(np.clip(0.5 * chord, 0.0, 1.0))
    weight = weight[..., None]
    sine = np.sin(angle)
    near = sine < 1e-9
    safe = np.where(near, 1.0, sine)
    low = np.where(near, 1 - weight, np.sin((1 - weight) * angle) / safe)
    high = np.where(near, weight, np.sin(weight * angle) / safe)
    mixed = low * first + high * second
    return np.asarray(mixed / np.linalg.norm(mixed, axis=-1, keepdims=True))


@dataclass(frozen=True, slots=True)
class _Bracket:
    """The samples around each query."""

    before: NDArray[np.int64]
    after: NDArray[np.int64]
    weight: Floats
    inside: Bools
    age: Floats
    valid: Bools


def _bracket(times: Times, query: Times, max_age: float) -> _Bracket:
    if not len(times):
        none = np.zeros(len(query), np.int64)
        nan = np.full(len(query), np.nan)
        no = np.zeros(len(query), np.bool_)
        return _Bracket(none, none, nan, no, nan, no.copy())
    behind = np.searchsorted(times, query, side="right").astype(np.int64)
    before = np.clip(behind - 1, 0, len(times) - 1)
    inside = (query >= times[0]) & (query <= times[-1])
    exact = times[before] == query
    after = np.where(exact, before, np.minimum(behind, len(times) - 1))
    gap_ns = times[after] - times[before]
    to_before, to_after = query - times[before], times[after] - query
    weight = np.divide(to_before, gap_ns, out=np.zeros(len(query)), where=gap_ns > 0)
    weight[~inside] = 0.0
    age = np.minimum(to_before, to_after) * NS
    valid = inside & (np.maximum(to_before, to_after) * NS <= max_age)
    age[~inside] = np.nan
    return _Bracket(before, after, weight, inside, age, valid)


def _picked(times: Times, query: Times, index: NDArray[np.int64], max_age: float) -> Picked:
    age = np.full(len(query), np.nan)
    some = index >= 0
    age[some] = (query[some] - times[index[some]]) * NS
    valid = np.zeros(len(query), np.bool_)
    valid[some] = np.abs(age[some]) <= max_age
    return Picked(index, age, valid)


def _sums(values: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
    """Return the sums of values[first:last] for each pair, none of them empty.

    Each interval is summed separately rather than by differences of a running sum, so that a NaN
    affects only the intervals that contain it.
    """
    offset = int(first.min())
    part = np.asarray(values[offset : int(last.max())], np.float64)
    # reduceat needs every index inside, so a row of zeros is appended.
    padded = np.concatenate([part, np.zeros((1, *part.shape[1:]))])
    pairs = np.stack([first - offset, last - offset], axis=1).reshape(-1)
    return np.asarray(np.add.reduceat(padded, pairs, axis=0)[::2])


# The streams of one run, prepared for alignment: capture times and values in memory.

# Exposure assumed for a camera that does not state it [s].
EXPOSURE = 1 / 60
_MAX_AGE_PERIODS = 2.0


@dataclass(frozen=True, slots=True)
class Source:
    """One stream of one run."""

    name: str
    traits: Traits
    """Kind, alignment, roles and clock."""
    times: Times
    """Capture times (m,) [ns], ascending."""
    rows: NDArray[np.int64]
    """Row number of each in its stream (m,)."""
    values: Array | None
    """Values (m, ...); None for images and text, which stay on disk."""
    is_pose: bool
    """True if a value is a position and a rotation vector."""
    max_age: float
    """Oldest value that is still valid [s]."""
    exposure: float
    """Exposure time before a capture [s]."""
    losses: Losses
    """Lost samples, placed between the captures around them."""
    bad: Bools
    """True for samples that are no number on a measured axis, or that the device marks (m,)."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Recorded streams of a run."""

    streams: Mapping[str, Source]
    """Streams by name, in the session's order; those with alignment `none` are left out."""
    columns: Mapping[str, str]
    """Column of `frames` by stream."""
    signal: Source | None
    """Stream that the others are aligned to."""


def source(stream: Columns, rows: slice, losses: Losses) -> Source:
    """Return some rows of a stream with their capture times, and the losses in them."""
    times = captured(stream)[rows]
    numbers = np.arange(len(stream.t_ns), dtype=np.int64)[rows]
    column = stream.value_column
    values = stream.array("value")[rows] if column is not None and column.is_number else None
    lost, bad = losses.on(times), bad_samples(stream, rows, values)
    if np.any(np.diff(times) < 0):
        order = np.argsort(times, kind="stable")
        times, numbers, bad = times[order], numbers[order], bad[order]
        values = None if values is None else values[order]
    max_age = max(stream.traits.defaults.max_age, _MAX_AGE_PERIODS / stream.rate_hz)
    return Source(
        stream.name,
        stream.traits,
        times,
        numbers,
        values,
        column is not None and column.is_pose,
        _number(stream, "max_age", max_age),
        _number(stream, "exposure", EXPOSURE),
        lost,
        bad,
    )


# Sizes of a wrench [N, N m] above which a sample is no measurement, where its stream has none of
# its own: gauges for sensors of touch are rated for up to some 1,000 N.
NO_WRENCH = (1e4, 1e4, 1e4, 1e3, 1e3, 1e3)


def largest(stream: Columns) -> Floats:
    """Return the sizes (6,) of a wrench [N, N m] that a sample of its gauge may have."""
    return np.asarray(stream.attrs.get("largest") or NO_WRENCH, np.float64)


def bad_samples(stream: Columns, rows: slice, values: Array | None) -> Bools:
    """Return True for samples that cannot be used (m,).

    They are no number on an axis that is measured, larger than the stream's attribute `largest`
    allows, or have a bit of its attribute `untrusted` in their status word.
    """
    bad = np.zeros(len(stream.t_ns[rows]), np.bool_)
    if values is not None and values.dtype.kind == "f":
        numbers = measured(stream, values)
        with np.errstate(invalid="ignore"):
            bad |= ~np.isfinite(numbers).all(axis=1)
            if stream.traits.kind == "force":
                limits = measured(stream, largest(stream)[None])
                bad |= (np.abs(numbers) > limits).any(axis=1)
    words = untrusted_words(stream)
    return bad if words is None else bad | (words[rows] != 0)


def untrusted_words(stream: Columns) -> NDArray[np.int64] | None:
    """Return the bits of each status word (m,) that make a sample untrusted; None without any."""
    bits = int(stream.attrs.get("untrusted") or 0)
    if not bits or "status" not in stream.names:
        return None
    return np.asarray(stream.array("status"), np.int64) & bits


def measured(stream: Columns, values: Array) -> Array:
    """Return those of the values (n, ...) of each row that the device measures (n, m)."""
    axes = stream.attrs.get("axes_measured")
    if values.shape[1:] != (len(AXES),) or not isinstance(axes, list):
        return flat(values)
    return values[:, np.isin(AXES, axes)]


def changed(stream: Columns, values: Array | Rows) -> Bools:
    """Return True for rows that differ from the one before on a measured axis (n + 1,).

    The first is True, and so is the end behind the last; two NaN differ.
    """
    differs = np.ones(len(values) + 1, np.bool_)
    for part in blocks(len(values) - 1):
        some = measured(stream, values[part.start : part.stop + 1])
        differs[1:][part] = (some[1:] != some[:-1]).any(axis=1)
    return differs


def flat(values: Array) -> Array:
    """Return the values (n, ...) of each row as one row of numbers (n, m)."""
    return values.reshape(len(values), int(np.prod(values.shape[1:])))


def has_device_times(stream: Columns) -> bool:
    """Return True if samples are aligned by the device's own time, not that of their arrival."""
    return stream.traits.clock == "monotonic" and "device_t" in stream.names


def captured(stream: Columns) -> Times:
    """Return the capture time of each row (n,) [ns], as far as the stream gives it.

    This is arrival minus attrs `latency` [s]; or the device's own time if the stream's clock is
    `monotonic`, because then both are the same clock (V4L2). The capture of an image is the end of
    its exposure, which a device may stamp at its start or middle.
    """
    arrived = stream.t_ns - round(_number(stream, "latency", 0.0) / NS)
    if not has_device_times(stream):
        return arrived
    device_t = stream.array("device_t")
    has_device_time = np.isfinite(device_t)
    stamped = np.round(np.where(has_device_time, device_t, 0.0) / NS).astype(np.int64)
    stamped += round(STAMPS[stream.traits.stamp] * _number(stream, "exposure", EXPOSURE) / NS)
    return np.where(has_device_time, stamped, arrived)


def _number(stream: Columns, key: str, default: float) -> float:
    """Return an attribute, or `default` if it is missing or null (unknown)."""
    value = stream.attrs.get(key)
    return default if value is None else float(value)


# Rows of a window, used by both `frames` and `Session.window`.
#
# Each tick gets the latest sample of the signal. All other values are aligned to the capture time
# of that sample, because a label must match its image, not the tick.


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
    """True if all samples used are near enough and can be used, and none needed is lost (n,)."""


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
        distances = [
            np.abs(stream.age)
            for name, stream in self.streams.items()
            if stream.traits.roles and name != self.signal
        ]
        if not distances:
            return np.full(len(self.t_ns), np.nan)
        return np.asarray(np.fmax.reduce(distances))


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
        pick = nearest if chosen[signal.name] == "nearest" else held
        picked = pick(signal.times, ticks, max_age=signal.max_age)
        some = picked.index >= 0
        capture, exposure = ticks.copy(), signal.exposure
        capture[some] = signal.times[picked.index[some]]
        rows[some] = signal.rows[picked.index[some]]
    streams = {
        name: _sampled(source, picked, ticks)
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
    methods = ["latest", "nearest"]
    if source.values is not None:
        methods += ["interpolated", *([] if source.is_pose else ["mean"])]
    if method not in methods:
        raise SessionError(f"{source.name}: found method {method!r}; known: {', '.join(methods)}")
    return method


def _aligned(source: Source, method: str, capture: Times, exposure: float) -> AlignedStream:
    if source.values is None or method in ("latest", "nearest"):
        pick = nearest if method == "nearest" else held
        return _sampled(source, pick(source.times, capture, max_age=source.max_age), capture)
    aligned: Aligned
    if method == "mean":
        start, stop = capture - round(exposure / NS), capture
        aligned = mean(source.times, source.values, start, stop, max_age=source.max_age)
        lost = source.losses.touch(start, stop)
        alike = partial(mean, start=start, stop=stop)
    else:
        interpolate = pose if source.is_pose else linear
        aligned = interpolate(source.times, source.values, capture, max_age=source.max_age)
        lost = source.losses.around(capture)
        alike = partial(linear, query=capture)
    if source.bad.any():  # a value is bad if a bad sample has a part in it
        lost = lost | (alike(source.times, source.bad[:, None]).value[:, 0] > 0)
    return AlignedStream(source.traits, aligned.value, None, aligned.age, aligned.valid & ~lost)


def _sampled(source: Source, picked: Picked, moments: Times) -> AlignedStream:
    """Return samples, or rows of images and text; not valid where one nearer was lost."""
    some = picked.index >= 0
    rows = np.full(len(picked.index), -1, np.int64)
    rows[some] = source.rows[picked.index[some]]
    value = None
    if source.values is not None:
        value = np.full((len(rows), *source.values.shape[1:]), np.nan)
        value[some] = source.values[picked.index[some]]
    sampled = moments.copy()
    sampled[some] = source.times[picked.index[some]]
    lost = source.losses.touch(np.minimum(sampled, moments), np.maximum(sampled, moments))
    lost[some] |= source.bad[picked.index[some]]
    return AlignedStream(source.traits, value, rows, picked.age, picked.valid & ~lost)


def _value(stream: AlignedStream | None) -> NDArray[Any] | None:
    return None if stream is None else stream.value
