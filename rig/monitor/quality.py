"""Quality of what a running collection records: lost markers, drift at rest, odd forces.

The session is read as it is written, in the page's process and a few times per second, so that no
sample waits for it. A sensor is at rest while the tip is clear of its surface.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import simplejpeg
from numpy.lib.stride_tricks import sliding_window_view

from recorder.errors import SessionError
from recorder.markers import MarkerCheck, smallest_marker
from recorder.session import Stream
from recorder.spec import frame_columns
from recorder.store import ImageTail, open_tail
from rig.acquire.signal_level import picture
from rig.bench.bench import Bench, BenchStream
from rig.core.clock import SECOND_NS
from rig.core.geometry import invert, transform
from rig.core.guard import AXES
from rig.monitor.predictor import open_segmenter
from trajectories import dome_height

if TYPE_CHECKING:
    from rig.monitor.predictor import Segmenter

Array = np.ndarray[Any, Any]
State = Literal["good", "watch", "fault", "unknown"]

# The tip is clear of the surface above this fraction of the plan's clearance, at which it waits.
_CLEAR = 0.5
# Shortest rest that is averaged, and longest part of it [s].
_REST, _REST_MOST = 0.1, 1.0
# An image is at rest if the tip has been clear for this long: cameras are late [s].
_IMAGE_REST = 0.1
# Time over which places of the tip are kept [s].
_HISTORY = 10.0
# A spike deviates from the median of this many samples by this many of their deviations, and by
# more than a force that counts as contact; not looked for in gauges slower than this [Hz].
_WINDOW, _DEVIATIONS, _SLOWEST_HZ = 11, 8.0, 50.0
# Anomalies that a recording may have.
_WATCHED = {"spike", "sample near the rating"}
# A gauge is saturated if this many samples above the soft limit are equal.
_EQUAL = 5
# Largest mean difference of an image at rest from the reference [grey levels of 255].
IMAGE_DRIFT = 2.0
# Largest change of a taxel at rest, as a fraction of the largest signal.
TAXEL_DRIFT = 0.1
# Most gauges that are judged.
_MOST_GAUGES = 2
# Fraction of the markers that may be hidden by a contact.
HIDDEN = 0.05


@dataclass(frozen=True, slots=True)
class QualityRow:
    """One row of the page."""

    name: str
    """Stream, or a property of it."""
    state: State
    """`unknown` as long as, or because, it cannot be judged."""
    text: str
    """Reason, with numbers and units."""


class _Growing:
    """New rows of a stream that is being recorded; those of earlier runs are left out."""

    def __init__(self, group: Path) -> None:
        self._group = group
        self._stream: Stream | None = None
        self.count = 0
        """Number of rows up to now."""
        if group.exists():
            self._stream = Stream(group, live=True)
            self.count = len(self._stream)

    def all(self, name: str) -> Array:
        """Return all rows of a column (n, ...); none if the stream does not exist yet."""
        stream = self._refreshed()
        return np.zeros(0) if stream is None else stream.array(name)

    def new(self, *names: str, until: int | None = None) -> list[Array] | None:
        """Return new rows (n, ...) of columns, `t_ns` first, up to `until` [ns]; None without."""
        stream = self._refreshed()
        if stream is None:
            return None
        columns = [stream.rows_between(n, self.count, len(stream)) for n in ("t_ns", *names)]
        count = len(columns[0])
        if until is not None:
            count = int(np.searchsorted(columns[0], until, side="right"))
        self.count += count
        return [column[:count] for column in columns] if count else None

    def _refreshed(self) -> Stream | None:
        if self._stream is not None:
            self._stream.refresh()
        elif self._group.exists():
            self._stream = Stream(self._group, live=True)
        return self._stream


class _Tip:
    """Where the tip was in the last seconds."""

    def __init__(self, bench: Bench, streams: Path, clearance: float) -> None:
        self._bench = bench
        self._to_contact = invert(bench.contact_frame)
        self._clear = _CLEAR * clearance
        self._poses = _Growing(streams / bench.of_kind("pose")[0].name)
        self._t_ns = np.zeros(0, np.int64)
        self._free = np.zeros(0, np.bool_)
        self._outside = np.zeros(0, np.bool_)

    @property
    def newest_ns(self) -> int:
        """Time up to which its places are known [ns]."""
        return int(self._t_ns[-1]) if len(self._t_ns) else 0

    def look(self) -> None:
        """Add the new places."""
        if (rows := self._poses.new("value")) is None:
            return
        t_ns, pose = rows
        tips = transform(self._to_contact, pose[:, :3])
        radius = self._bench.dome_radius
        surface = [dome_height(radius, x, y) for x, y in tips[:, :2].tolist()]
        limits = self._bench.limits
        outside = np.zeros(len(t_ns), np.bool_)
        for axis, (low, high) in enumerate((limits.box_x, limits.box_y)):
            outside |= (tips[:, axis] < low) | (tips[:, axis] > high)
        free = (tips[:, 2] - surface > self._clear) | outside
        self._t_ns = np.concatenate([self._t_ns, t_ns])
        self._free = np.concatenate([self._free, free])
        self._outside = np.concatenate([self._outside, outside])
        recent = slice(np.searchsorted(self._t_ns, t_ns[-1] - round(_HISTORY * SECOND_NS)), None)
        self._t_ns, self._free = self._t_ns[recent], self._free[recent]
        self._outside = self._outside[recent]

    def free(self, t_ns: Array) -> Array:
        """Return True at the times (n,) [ns] before and after which the tip was clear."""
        return self._free[self._before(t_ns)] & self._free[self._after(t_ns)]

    def outside(self, t_ns: Array) -> bool:
        """Return True if the tip was outside of the box at any of the times (n,) [ns]."""
        return bool(self._outside[self._before(t_ns)].any())

    def at_rest(self, t_ns: Array) -> Array:
        """Return True at the times (n,) [ns] at which the tip has been clear for a while."""
        first = self._before(t_ns - round(_IMAGE_REST * SECOND_NS))
        touched = np.concatenate([[0], np.cumsum(~self._free)])
        in_history = t_ns - round(_IMAGE_REST * SECOND_NS) >= self._t_ns[0]
        return np.asarray(in_history & (touched[self._after(t_ns) + 1] == touched[first]))

    def _before(self, t_ns: Array) -> Array:
        return np.maximum(np.searchsorted(self._t_ns, t_ns, side="right") - 1, 0)

    def _after(self, t_ns: Array) -> Array:
        return np.minimum(np.searchsorted(self._t_ns, t_ns), len(self._t_ns) - 1)


class _Rests:
    """Means of a stream while nothing touches the sensor."""

    def __init__(self) -> None:
        self._t_ns = np.zeros(0, np.int64)
        self._values = np.zeros(0)
        self._number = 0

    def add(self, t_ns: Array, values: Array, free: Array) -> Iterator[tuple[int, Array, Array]]:
        """Yield number, times (m,) [ns] and median (k,) of each rest that is long enough.

        `free` (n,) is True where nothing touches the sensor: times (n,) [ns], samples (n, k).
        """
        bounds = np.flatnonzero(np.diff(free)) + 1
        for first, last in zip([0, *bounds], [*bounds, len(t_ns)], strict=True):
            if not free[first]:
                self._t_ns = np.zeros(0, np.int64)
                continue
            if not len(self._t_ns):
                self._number += 1
                self._values = np.zeros((0, values.shape[1]))
            self._t_ns = np.concatenate([self._t_ns, t_ns[first:last]])
            self._values = np.concatenate([self._values, values[first:last]])
            since = self._t_ns[-1] - round(_REST_MOST * SECOND_NS)
            begin = int(np.searchsorted(self._t_ns, since))
            self._t_ns, self._values = self._t_ns[begin:], self._values[begin:]
            if self._t_ns[-1] - self._t_ns[0] >= _REST * SECOND_NS and len(self._t_ns) > 2:
                yield self._number, self._t_ns, np.median(self._values, axis=0)


class _Gauge:
    """Drift and anomalies of one gauge."""

    def __init__(self, bench: Bench, gauge: BenchStream, streams: Path, start_ns: int) -> None:
        self._name, self._start_ns = gauge.name, start_ns
        self._allowed = bench.preflight.contact_free
        self._axes = [
            k for k, (axis, _) in enumerate(AXES[:3]) if axis in gauge.config.axes_measured
        ]
        self._ratings = np.array(bench.force_rating[:3])[self._axes]
        self._soft, self._hard = bench.limits.soft_fraction, bench.limits.hard_fraction
        self._untrusted = gauge.config.UNTRUSTED_MASK
        self._is_fast = gauge.rate_hz >= _SLOWEST_HZ
        self._rows = _Growing(streams / gauge.name)
        self._rests = _Rests()
        self._before = np.zeros((0, len(self._axes)))
        self._flat = np.zeros((1, len(self._axes)), np.bool_)
        self._rest: Array | None = None
        self._touched = 0
        self._samples = 0
        # Number of occurrences, and the last one as text, by anomaly.
        self._anomalies: dict[str, tuple[int, str]] = {}

    def look(self, tip: _Tip) -> None:
        """Judge the samples that were recorded since."""
        if (rows := self._rows.new("value", "status", until=tip.newest_ns)) is None:
            return
        t_ns, wrench, status = rows
        if (bad := np.flatnonzero(status & self._untrusted)).size:
            text = f"status 0x{int(status[bad[-1]]):x}: overloaded, or a cable is loose"
            self._note("invalid sample", bad.size, int(t_ns[bad[-1]]), text)
        force = wrench[:, self._axes]
        finite = np.isfinite(force).all(axis=1)
        t_ns, force = t_ns[finite], force[finite]
        if not len(t_ns):
            return
        self._samples += len(t_ns)
        self._at_rest(tip, t_ns, force)
        self._near_rating(t_ns, force)
        if self._is_fast:
            self._spikes(t_ns, force)
            self._saturation(t_ns, force)
            self._before = np.concatenate([self._before, force])[1 - _WINDOW :]

    def rows(self) -> Iterator[QualityRow]:
        """Yield the rows of the page."""
        name, allowed = self._name, self._allowed
        if self._rest is None:
            yield QualityRow(f"{name} drift", "unknown", "waiting for the tip to be clear")
        else:
            axis, worst = self._worst(self._rest)
            state: State = "good" if worst <= allowed / 2 else "watch"
            more = "" if state == "good" else f" ({axis}): tare it again soon"
            if worst > allowed:
                state, more = "fault", f" ({axis}): a drift, or something touches the sensor"
            text = f"{worst:.2f} of {allowed:.2f} N{more}"
            yield QualityRow(f"{name} drift", state, text)
        if not self._samples:
            yield QualityRow(name, "unknown", "no sample yet")
            return
        if not self._anomalies:
            yield QualityRow(name, "good", f"no anomaly in {self._samples:,} samples")
            return
        texts = [
            f"{count} x {what}, the last at {text}"
            for what, (count, text) in self._anomalies.items()
        ]
        state = "watch" if set(self._anomalies) <= _WATCHED else "fault"
        yield QualityRow(name, state, "; ".join(texts))

    def _worst(self, force: Array) -> tuple[str, float]:
        axis = int(np.argmax(np.abs(force)))
        return AXES[self._axes[axis]][0], float(abs(force[axis]))

    def _note(self, what: str, count: int, t_ns: int, text: str) -> None:
        minutes, seconds = divmod(max(t_ns - self._start_ns, 0) // SECOND_NS, 60)
        before = self._anomalies.get(what, (0, ""))[0]
        self._anomalies[what] = (before + count, f"{minutes}:{seconds:02}, {text}")

    def _at_rest(self, tip: _Tip, t_ns: Array, force: Array) -> None:
        for number, times, mean in self._rests.add(t_ns, force, tip.free(t_ns)):
            self._rest = mean
            axis, worst = self._worst(mean)
            if worst <= self._allowed:
                continue
            tip_is = "outside of the box" if tip.outside(times) else "clear of the surface"
            text = f"{axis} of {worst:.2f} N with the tip {tip_is}"
            self._note("force without contact", int(number != self._touched), int(times[-1]), text)
            self._touched = number

    def _near_rating(self, t_ns: Array, force: Array) -> None:
        load = np.abs(force) / self._ratings
        # A press ends at the soft limit, a little above it; so far beyond it none should come.
        near = (self._soft + self._hard) / 2
        if (high := np.flatnonzero((load >= near).any(axis=1))).size:
            worst = high[int(load[high].max(axis=1).argmax())]
            axis = int(load[worst].argmax())
            text = (
                f"{AXES[self._axes[axis]][0]} of {force[worst, axis]:+.2f} N, "
                f"{load[worst, axis]:.0%} of the rating"
            )
            what = "near" if load[high].max() < self._hard else "beyond"
            self._note(f"sample {what} the rating", high.size, int(t_ns[high[-1]]), text)

    def _saturation(self, t_ns: Array, force: Array) -> None:
        joined = np.concatenate([self._before, force])[-(len(force) + _EQUAL - 1) :]
        if len(joined) < _EQUAL:
            return
        windows = sliding_window_view(joined, _EQUAL, axis=0)
        loaded = np.abs(windows[..., 0]) >= self._soft * self._ratings
        flat = loaded & (windows == windows[..., :1]).all(axis=-1)
        begun = flat & ~np.concatenate([self._flat, flat[:-1]])
        self._flat = flat[-1:]
        for row, axis in np.argwhere(begun)[-1:]:
            last = row - len(begun)
            text = f"{AXES[self._axes[axis]][0]} stays at {force[last, axis]:+.3f} N"
            self._note("saturation", int(begun.sum()), int(t_ns[last]), text)

    def _spikes(self, t_ns: Array, force: Array) -> None:
        """Note samples that stand out from those around them (Hampel's filter)."""
        joined = np.concatenate([self._before, force])
        if len(joined) < _WINDOW:
            return
        windows = sliding_window_view(joined, _WINDOW, axis=0)
        median = np.median(windows, axis=-1)
        spread = 1.4826 * np.median(np.abs(windows - median[..., None]), axis=-1)
        off = windows[..., _WINDOW // 2] - median
        wrong = np.abs(off) > np.maximum(self._allowed, _DEVIATIONS * spread)
        rows = np.flatnonzero(wrong.any(axis=1))
        if not rows.size:
            return
        count = 1 + int(np.count_nonzero(np.diff(rows) > 1))
        axis = int(np.abs(off[rows[-1]]).argmax())
        text = f"{AXES[self._axes[axis]][0]} by {off[rows[-1], axis]:+.2f} N"
        last = max(int(rows[-1]) + _WINDOW // 2 - len(self._before), 0)
        self._note("spike", count, int(t_ns[last]), text)


class _TaxelDrift:
    def __init__(self, bench: Bench, row: BenchStream, streams: Path) -> None:
        self._name = row.name
        self._rows = _Growing(streams / row.name)
        self._rests = _Rests()
        self._first: Array | None = None
        self._drift: float | None = None
        self._largest = 0.0 if bench.stand_ins is None else bench.stand_ins.signal_max

    def look(self, tip: _Tip) -> None:
        """Judge the samples that were recorded since."""
        if (rows := self._rows.new("value", until=tip.newest_ns)) is None:
            return
        t_ns, counts = rows[0], rows[1].reshape(len(rows[0]), -1).astype(float)
        for _, _, mean in self._rests.add(t_ns, counts, tip.free(t_ns)):
            self._first = mean if self._first is None else self._first
            self._drift = float(np.abs(mean - self._first).max())
        if self._first is not None:
            self._largest = max(self._largest, float(np.abs(counts - self._first).max()))

    def rows(self) -> Iterator[QualityRow]:
        """Yield the row of the page."""
        name = f"{self._name} drift"
        if self._drift is None:
            yield QualityRow(name, "unknown", "waiting for the tip to be clear")
            return
        allowed = TAXEL_DRIFT * self._largest
        text = f"{self._drift:.0f} of {allowed:.0f} counts"
        is_good = self._drift <= allowed
        more = "" if is_good else ": its signal without contact is another one now"
        yield QualityRow(name, "good" if is_good else "fault", text + more)


class _Camera:
    """Markers of a camera's images, and their drift, by the reference of the first point."""

    def __init__(self, bench: Bench, row: BenchStream, session: Path) -> None:
        self._sensor, self._name = bench.sensor, row.name
        self._group = session / "streams" / row.name
        self._column = frame_columns((each.name, each.traits) for each in bench.rows)[row.name]
        self._rows = _Growing(self._group)
        self._reference = _Growing(session / "reference")
        self._tail: ImageTail | None = None
        self._rest: Array | None = None
        self._drift: float | None = None
        self._segmenter: Segmenter | None = None
        self._check: MarkerCheck | None = None
        self._turn = 0
        self._looked = self._lost = 0
        self._markers = QualityRow("markers", "unknown", "waiting for the reference image")

    def look(self, tip: _Tip) -> None:
        """Judge one image: the last one at rest if there is a new one, else the newest, in turn."""
        if not self._group.exists():
            return
        self._tail = self._tail or open_tail(self._group)
        first, rows = self._rows.count, self._rows.new(until=tip.newest_ns)
        if (self._rest is None and not self._begin()) or rows is None:
            return
        self._turn += 1
        rest = np.flatnonzero(tip.at_rest(rows[0]))
        row = first + (int(rest[-1]) if rest.size else len(rows[0]) - 1)
        if not rest.size and self._turn % 2:
            return
        try:
            self._judge(row, is_rest=rest.size > 0)
        except ValueError as error:
            self._markers = QualityRow("markers", "fault", f"image {row}: {error}")

    def rows(self) -> Iterator[QualityRow]:
        """Yield the rows of the page."""
        yield self._markers
        name = f"{self._name} drift"
        if self._drift is None:
            yield QualityRow(name, "unknown", "waiting for an image without contact")
            return
        is_good = self._drift <= IMAGE_DRIFT
        text = f"{self._drift:.1f} of {IMAGE_DRIFT:.1f} grey levels"
        more = "" if is_good else ": the light, the focus or the gel changed"
        yield QualityRow(name, "good" if is_good else "fault", text + more)

    def _begin(self) -> bool:
        """Take the reference image; return False as long as there is none."""
        rows = self._reference.all(self._column)
        rows = rows[rows >= 0]
        data = self._tail.jpeg(int(rows[0])) if len(rows) and self._tail is not None else None
        if data is None:
            return False
        self._rest = picture(data)
        try:
            self._segmenter = open_segmenter(self._sensor)
            mask = self._segmenter.mask(simplejpeg.decode_jpeg(data))
            self._check = MarkerCheck(
                mask,
                smallest_px=smallest_marker(mask),
                tolerance=int(self._segmenter.preset.tolerance),
            )
        except ValueError as error:
            self._markers = QualityRow("markers", "unknown", f"not counted: {error}")
        return True

    def _judge(self, row: int, *, is_rest: bool) -> None:
        data = self._tail.jpeg(row) if self._tail is not None else None
        if data is None or self._rest is None:
            return
        if is_rest:
            self._drift = float(np.abs(picture(data) - self._rest).mean())
        if self._check is None or self._segmenter is None:
            return
        mask = self._segmenter.mask(simplejpeg.decode_jpeg(data))
        flags = self._check.flags(mask[None], row)
        self._looked += 1
        expected = self._check.expected
        if not flags:
            past = f"; missing in {self._lost} of {self._looked} images" if self._lost else ""
            text = f"all {expected} are seen{past}"
            self._markers = QualityRow("markers", "good", text)
            return
        flag = flags[0]
        hidden = expected - flag.found
        if not is_rest and abs(hidden) <= HIDDEN * expected:
            return
        self._lost += 1
        load = "at rest" if is_rest else "in contact"
        text = f"{flag.found} of {expected} seen {load} (image {row}): {flag.reason}"
        self._markers = QualityRow("markers", "fault" if is_rest else "watch", text)


class LiveQuality:
    """Quality of all that a running collection records, in a session that may not exist yet.

    The tip waits at the height `clearance` above the surface before a press [m]; the times that are
    shown begin at `start_ns` [ns].
    """

    def __init__(self, bench: Bench, session: Path, clearance: float, start_ns: int) -> None:
        streams = session / "streams"
        self._tip = _Tip(bench, streams, clearance)
        self._parts: list[_Gauge | _TaxelDrift | _Camera] = []
        cameras, taxels = bench.of_kind("camera"), bench.of_kind("taxels")
        self._parts += [_Camera(bench, row, session) for row in cameras[:1]]
        self._parts += [_TaxelDrift(bench, row, streams) for row in taxels[:1]]
        gauges = bench.of_kind("force")
        self._parts += [_Gauge(bench, row, streams, start_ns) for row in gauges[:_MOST_GAUGES]]

    def look(self) -> list[QualityRow]:
        """Judge what was recorded since the last call; return the rows of the page."""
        try:
            self._tip.look()
            if self._tip.newest_ns:
                for part in self._parts:
                    part.look(self._tip)
        except (SessionError, OSError) as error:
            return [QualityRow("session", "fault", f"cannot be read: {error}")]
        return [row for part in self._parts for row in part.rows()]
