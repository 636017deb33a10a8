"""Estimate a device clock's offset and drift against the host clock under positive delays.

Data over a network or USB never arrives early, but sometimes far too late. The fit is therefore
a line under the points (device time, arrival minus device time): of all lines below them, the one
with the least total distance. That is the edge of their lower convex hull above their mean
(Moon, Skelly and Towsley, INFOCOM 1999). It is repeated in windows of 30 s, to follow a clock
that warms up. The least delay of the transport itself cannot be observed in this way; it remains
in the offset unless the caller supplies it. Pure functions, numpy only.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.columns import Stream
from recorder.session.reader import Session
from recorder.store.documents import merge_attrs

Floats = NDArray[np.float64]

# Window of a fit [s]: long enough to catch prompt arrivals, short enough for a warming clock.
WINDOW = 30.0
# Periods after which counters of these bits and ticks wrap [s].
WRAPS = tuple(2.0**bits * tick for bits in (16, 24, 31, 32) for tick in (1e-9, 1e-6, 1e-3))
# A permanent change of the offset by more than this is a reset of the device's clock [s].
STEP = 0.02

# A drift whose interval is wider than this to either side says nothing of a clock [ppm].
DRIFT_KNOWN = 50.0

_PARTS = 16  # parts of a recording whose promptest arrivals show how well its drift is known
_T_95 = 2.2  # Student's t of about as many parts
_BINS = 64  # least delays kept per window
_KNOTS = 3  # fits per window length
_LEAST_SAMPLES, _LEAST_SPAN = 16, 2.0
_WRAP_SLACK = 0.5  # a wrap must explain the jump this well [s]
_BLOCK = 1.0  # resets are searched for between blocks of about this length [s]
_PERSIST = 3  # blocks on either side that must agree


@dataclass(frozen=True, slots=True)
class ClockPiece:
    """The fit of the rows between two resets of the device's clock."""

    first_row: int
    """First row of the fit."""
    rows: int
    offset: float
    """Value added to `device_t` at the first row to get host time [s]."""
    drift_ppm: float
    """Mean drift of the device's clock against the host's [ppm]; positive is fast."""
    residual_rms: float
    """RMS of arrival minus mapped time: the variation of the delays [s]."""
    drift_interval_ppm: float
    """Half of the 95 % interval of the drift [ppm]; inf or NaN if it is not known."""
    device_t: Floats
    """Knots (k,): device time since the first knot's origin, unwrapped [s]."""
    host_minus_device: Floats
    """Offset at the knots (k,) [s]."""


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Maps a device's time to the host's."""

    pieces: tuple[ClockPiece, ...]
    """One per stretch without a reset, in order."""
    wrap: float | None
    """Period after which the device's clock wraps [s]; None if no wrap was seen."""

    @property
    def drifts(self) -> bool:
        """True if the drift of the last piece is known well enough to mean something."""
        piece = self.pieces[-1]
        return bool(
            piece.drift_interval_ppm < abs(piece.drift_ppm)
            and piece.drift_interval_ppm <= DRIFT_KNOWN
        )

    @property
    def resets(self) -> int:
        """Number of resets of the device's clock."""
        return max(len(self.pieces) - 1, 0)

    def to_host(self, device_t: Floats, piece: int = 0) -> Floats:
        """Return host times (n,) [s] of unwrapped device times (n,) [s] of one piece."""
        part = self.pieces[piece]
        return np.asarray(device_t + _interpolated(part, np.asarray(device_t, np.float64)))

    def to_json(self) -> dict[str, Any]:
        """Return plain values for a stream's attributes."""
        pieces = [
            {
                "first_row": part.first_row,
                "rows": part.rows,
                "offset_s": part.offset,
                "drift_ppm": part.drift_ppm,
                "drift_interval_ppm": _finite(part.drift_interval_ppm),
                "residual_rms_s": part.residual_rms,
                "knots_device_t": part.device_t.tolist(),
                "knots_host_minus_device": part.host_minus_device.tolist(),
            }
            for part in self.pieces
        ]
        method = "lower envelope, two-sided"
        return {"method": method, "window_s": WINDOW, "wrap_s": self.wrap, "pieces": pieces}

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> Self:
        """Return the fit that `to_json` wrote."""
        pieces = tuple(
            ClockPiece(
                int(part["first_row"]),
                int(part["rows"]),
                float(part["offset_s"]),
                float(part["drift_ppm"]),
                float(part["residual_rms_s"]),
                float("nan" if (drift := part["drift_interval_ppm"]) is None else drift),
                np.array(part["knots_device_t"], np.float64),
                np.array(part["knots_host_minus_device"], np.float64),
            )
            for part in stored["pieces"]
        )
        wrap = stored["wrap_s"]
        return cls(pieces, None if wrap is None else float(wrap))


def _finite(value: float) -> float | None:
    """Return a number that JSON can hold; None for any other."""
    return value if np.isfinite(value) else None


def fit_clock(device_t: Floats, t_ns: NDArray[np.int64]) -> ClockFit | None:
    """Fit device times (n,) [s], NaN for none, to arrivals [ns]; None if there are too few."""
    rows = np.flatnonzero(np.isfinite(device_t))
    if len(rows) < _LEAST_SAMPLES:
        return None
    # Relative to the first arrival: float64 would round nanoseconds since boot.
    origin_ns = int(t_ns[rows[0]])
    host = np.asarray((t_ns[rows] - origin_ns) * 1e-9, np.float64)
    device, wrap = _unwrapped(np.asarray(device_t, np.float64)[rows], host)
    offset = host - device
    bounds = [0, *_resets(host, offset), len(rows)]
    parts = [slice(*bound) for bound in pairwise(bounds)]
    fits = [
        _fit_piece(device[part], offset[part], int(rows[part.start]), origin_ns * 1e-9)
        for part in parts
    ]
    pieces = tuple(piece for piece in fits if piece is not None)
    return ClockFit(pieces, wrap) if pieces else None


def _unwrapped(device: Floats, host: Floats) -> tuple[Floats, float | None]:
    """Return unwrapped device times, and the wrap period if there was one."""
    change, passed = np.diff(device), np.diff(host)
    turns = np.zeros(len(device))
    period = None
    for row in np.flatnonzero(change < -STEP):
        wanted = passed[row] - change[row]
        fitting = [p for p in WRAPS if abs(p - wanted) < min(_WRAP_SLACK, 0.1 * p)]
        if fitting:
            period = min(fitting, key=lambda each: abs(each - wanted))
            turns[row + 1 :] += period
    return (device + turns if period else device), period


def _resets(host: Floats, offset: Floats) -> list[int]:
    """Return the rows at which the offset changes permanently by more than `STEP`."""
    span = float(host[-1] - host[0])
    count = int(min(max(span / _BLOCK, 1), len(offset) // 4))
    if count < 2:
        return []
    edges = np.linspace(0, len(offset), count + 1).astype(np.int64)
    least = np.minimum.reduceat(offset, edges[:-1])
    reset_rows: list[int] = []
    for block in range(1, count):
        # A reset inside a block affects the minima of two blocks: start from the block before it.
        before = float(least[max(block - _PERSIST, 0) : block].min())
        behind = least[block + 1 : block + 1 + _PERSIST]
        after = float(behind.min() if behind.size else least[block])
        if abs(after - before) <= STEP:
            continue
        low, high = int(edges[block - 1]), int(edges[min(block + 1, count)])
        steps = np.diff(offset[low:high]) * np.sign(after - before)
        row = low + 1 + int(steps.argmax())
        if (
            steps.size
            and steps.max() > STEP
            and (not reset_rows or row > reset_rows[-1] + _LEAST_SAMPLES)
        ):
            reset_rows.append(row)
    return reset_rows


def _fit_piece(device: Floats, offset: Floats, first_row: int, base: float) -> ClockPiece | None:
    """Return the fit of the rows between two resets; None for too few or too short a time.

    `offset` is the host's times less the unwrapped device times and less `base` (n,) [s].
    """
    first, last = float(device.min()), float(device.max())
    if len(device) < _LEAST_SAMPLES or last - first < _LEAST_SPAN:
        return None
    # Remove the drift of the whole piece first, so that a bin's minimum is its promptest arrival.
    trend, _ = _line_below(*_least_of_bins(device, offset, (last - first) / (4 * _BINS)))
    x, level = _least_of_bins(device, offset - trend * device, min(WINDOW, last - first) / _BINS)
    count = max(int(np.ceil((last - first) / WINDOW * _KNOTS)) + 1, 2)
    knots = np.linspace(first, last, count)
    values = np.empty(count)
    for number, knot in enumerate(knots):
        # At the ends the window keeps its length and the knot moves off its centre.
        start = max(first, float(knot) - WINDOW / 2)
        start = min(start, max(last - WINDOW, first))
        inside = (x >= start) & (x <= start + WINDOW)
        _, at_zero = _line_below(x[inside] - knot, level[inside])
        values[number] = at_zero + trend * knot
    drift = float(np.polyfit(knots - knots.mean(), values, 1)[0])
    residual = offset - np.interp(device, knots, values)
    return ClockPiece(
        first_row,
        len(device),
        base + float(np.interp(device[0], knots, values)),
        -1e6 * drift / (1 + drift),
        float(np.sqrt(np.mean(residual**2))),
        1e6 * _drift_interval(device, residual),
        knots,
        base + values,
    )


def _drift_interval(device: Floats, residual: Floats) -> float:
    """Return half of the 95 % interval of the drift.

    The promptest arrivals of equal parts of the time lie about the fitted line. Their scatter says
    how well its slope is known.
    """
    span = float(device.max() - device.min())
    part = np.minimum((device - device.min()) / span * _PARTS, _PARTS - 1).astype(np.int64)
    parts = np.unique(part)
    if len(parts) < 4:
        return float("inf")
    least = np.array([residual[part == number].min() for number in parts])
    at = (parts - parts.mean()) * span / _PARTS
    slope = float(at @ least / (at @ at))
    rest = least - least.mean() - slope * at
    error = float(np.sqrt(rest @ rest / (len(parts) - 2) / (at @ at)))
    return _T_95 * error + abs(slope)


def _least_of_bins(x: Floats, y: Floats, width: float) -> tuple[Floats, Floats]:
    """Return the lowest point of every bin of x, ascending in x."""
    bins = np.floor((x - x.min()) / width).astype(np.int64)
    order = np.lexsort((y, bins))
    chosen = order[np.concatenate([[True], np.diff(bins[order]) > 0])]
    return x[chosen], y[chosen]


def _line_below(x: Floats, y: Floats) -> tuple[float, float]:
    """Return slope and value at x = 0 of the line below all points with least total distance."""
    if len(x) < 2:
        return 0.0, float(y[0]) if len(y) else 0.0
    hull: list[tuple[float, float]] = []
    for point in zip(x.tolist(), y.tolist(), strict=True):
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    middle = float(x.mean())
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle and x1 > x0:
            slope = (y1 - y0) / (x1 - x0)
            return slope, y0 - slope * x0
    return 0.0, float(y.min())


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Return the cross product of a-b and a-c: above 0 for a turn to the left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _interpolated(piece: ClockPiece, device_t: Floats) -> Floats:
    """Return the offset (n,) [s] at device times, extrapolated linearly beyond the knots."""
    x, y = piece.device_t, piece.host_minus_device
    inside = np.interp(device_t, x, y)
    first, last = ((y[k + 1] - y[k]) / (x[k + 1] - x[k]) for k in (0, len(x) - 2))
    below = np.minimum(device_t - x[0], 0.0) * first
    above = np.maximum(device_t - x[-1], 0.0) * last
    return np.asarray(inside + below + above)


# Fit every device clock of a session to the host's, and store the fits.
#
# A fit is only reported, in attribute `clock_fit` of the stream; recorded times never change.


def fit_clocks(path: str | os.PathLike[str]) -> dict[str, list[dict[str, Any] | None]]:
    """Fit each stream that has a device time, run by run; store and return attribute `clock_fit`.

    By stream, it has one entry per run, None if too little was recorded. The streams of the session
    must be closed, the session itself not yet: `SessionWriter.finish` calls this on request.
    """
    session = Session(path)
    if session.status != "recording":
        raise SessionError(f"{session.name}: is closed; clocks are fitted when it is finished")
    fits: dict[str, list[dict[str, Any] | None]] = {}
    for name, stream in session.streams.items():
        clock = _device_clock(stream)
        if clock is None:
            continue
        source, device_t = clock
        entries: list[dict[str, Any] | None] = []
        for run in range(max(len(session.runs), 1)):
            rows = session.rows_of_run(name, run)
            fit = fit_clock(device_t[rows], stream.t_ns[rows])
            entries.append(None if fit is None else {"clock": source, **fit.to_json()})
        if any(entry is not None for entry in entries):
            fits[name] = entries
            merge_attrs(Path(path) / "streams" / name, {"clock_fit": entries})
    return fits


def clock_lines(session: Session) -> Iterator[str]:
    """Yield a line on each fitted clock whose drift or resets mean something, for the last run.

    A drift is silent whose interval contains 0, or is wider than `DRIFT_KNOWN`.
    """
    for name, stream in session.streams.items():
        entries = [entry for entry in stream.attrs.get("clock_fit", []) if entry is not None]
        if not entries:
            continue
        fit = ClockFit.from_json(entries[-1])
        piece = fit.pieces[-1]
        effects = []
        if fit.drifts:
            effects.append(f"drift {piece.drift_ppm:+.1f} +- {piece.drift_interval_ppm:.1f} ppm")
        if fit.resets:
            effects.append(f"{fit.resets} resets of the device's clock")
        if effects:
            yield (
                f"clock   {name:<7} {', '.join(effects)}, delays rms "
                f"{1e3 * piece.residual_rms:.2f} ms ({entries[-1]['clock']}); "
                "reported, not applied"
            )


def _device_clock(stream: Stream) -> tuple[str, NDArray[np.float64]] | None:
    """Return the source of the device's time and that time (n,) [s], or None."""
    if "device_t" in stream.small:
        device_t = np.asarray(stream.array("device_t"), np.float64)
        return ("device_t", device_t) if np.isfinite(device_t).any() else None
    rate = stream.attrs.get("device", {}).get("rate_hz")
    if "seq" in stream.small and rate:
        # A sequence number at a fixed rate is a clock that ticks once per sample.
        return f"seq at {rate:g} Hz", np.asarray(stream.array("seq") / float(rate))
    return None
