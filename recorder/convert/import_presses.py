"""Presses in a recording that has no plan: when nothing touched, and when something did.

A contact shows in the force if it was recorded, else in the images or taxels: as the change from a
span without contact.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_tracks import Floats, MissingAnswer, Times
from recorder.errors import SessionError
from recorder.session.align import NS
from recorder.spec import AXES

Span = tuple[int, int]

# A span without contact is at least this long [s] and has at least this many samples, but is at
# most this part of the recording.
_STILL_S, _STILL_SAMPLES, _STILL_MOST = 0.15, 5, 0.25
# Spans whose force differs by less than this part of the largest one are equally free of contact.
_AS_FREE = 0.02
# Part of the samples that a glitch may be; lengths of a span that a force without contact lasts in
# all; times that one lasts longer than another that does not count beside it; and change of images
# between two spans, over the largest, below which they show the same.
_GLITCH, _LASTS, _LONGER, _SEEN_ALIKE = 0.02, 2, 3.0, 0.25
# A recording that ends this far from its beginning, as part of its largest change, may begin or end
# in contact: images and taxels cannot tell which.
_RETURNED = 0.4
# Change during contact over that without, from which a contact differs from noise.
_CLEAR = 4.0
# A press begins where the change exceeds `_BEGIN` of its largest value or twice its noise, and
# reaches to where it falls below `_REACH`; interruptions shorter than `_GAP_S` are part of it.
_BEGIN, _REACH, _GAP_S, _PRESS_S = 0.10, 0.03, 0.15, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Change of a track from its span without contact."""

    name: str
    """Quantity and unit."""
    t_ns: Times
    """Times (n,) [ns]."""
    value: Floats
    """Size of the change (n,), 0 or more."""


@dataclass(frozen=True, slots=True)
class Press:
    """One contact."""

    start_ns: int
    peak_ns: int
    """Time of the largest change."""
    end_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """Samples in which a contact can show."""

    name: str
    """Quantity and unit."""
    t_ns: Times
    """Times (n,) [ns]."""
    rows: NDArray[np.floating[Any]]
    """Values that are compared with those of the span without contact (n, m)."""
    pressing: Floats | None = None
    """Pressing force (n,) [N], the larger the harder; None if the signal has no direction."""

    def within(self, span: Span) -> "Signal":
        """Return the part of the signal in a span."""
        inside = (self.t_ns >= span[0]) & (self.t_ns < span[1])
        pressing = None if self.pressing is None else self.pressing[inside]
        return Signal(self.name, self.t_ns[inside], self.rows[inside], pressing)

    def change(self, no_contact: Span) -> Trace:
        """Return the size of the change from a span."""
        free = self.within(no_contact).rows
        if not len(free):
            raise SessionError(
                f"--no-contact: {NS * no_contact[0]:.3f} to {NS * no_contact[1]:.3f} s holds no "
                f"sample of {self.name}"
            )
        rest = free.mean(axis=0)
        size = np.abs(self.rows - rest)
        value = np.linalg.norm(size, axis=1) if self.pressing is not None else size.mean(axis=1)
        return Trace(self.name, self.t_ns, np.asarray(value, np.float64))


def force_signal(t_ns: Times, wrench: Floats, axes: Sequence[str]) -> Signal:
    """Return the signal of forces (n, 6) [N, N m]; pressing is negative Fz."""
    measured = [AXES.index(axis) for axis in axes if axis in AXES[:3]]
    rows = wrench[:, measured or [0]]
    pressing = -wrench[:, 2] if "Fz" in axes else np.linalg.norm(rows, axis=1)
    return Signal("force [N]", t_ns, rows, np.asarray(pressing, np.float64))


def find_no_contact(signal: Signal, recording: str, seen: Signal | None = None) -> Span:
    """Return the span in which nothing touched the sensor [ns].

    With a force it is the first still span of the least pressing force that lasts. A recording that
    begins with more is free at its beginning if images or taxels, `seen`, are alike in both, or if
    that force comes back and lasts far longer, or the least one does not; else that must come back.
    With images or taxels alone it is the beginning, if the recording returns to it.

    Raises:
        MissingAnswer: Nothing tells which of two spans is free of contact.
    """
    length = _length(signal)
    if signal.pressing is not None:
        return _of_force(signal, signal.pressing, recording, length, seen)
    t_ns, count = signal.t_ns, len(signal.t_ns)
    begin, end = signal.rows[:length], signal.rows[-length:]
    change = np.abs(signal.rows - begin.mean(axis=0)).mean(axis=1)
    largest = float(change.max())
    apart = float(np.abs(end.mean(axis=0) - begin.mean(axis=0)).mean())
    noise = max(float(change[:length].max()), 1e-12)
    if largest > _CLEAR * noise and apart > _RETURNED * largest:
        raise _undecided(
            f"{recording}: {signal.name}: the recording ends {100 * apart / largest:.0f} % of its "
            "largest change away from its beginning, so one of them is in contact, and nothing "
            "tells which",
            recording,
            [_span(t_ns, at, length) for at in (0, count - length)],
        )
    return _span(t_ns, 0, length)


def _length(signal: Signal) -> int:
    """Return the number of samples of a span without contact."""
    count = len(signal.t_ns)
    step = float(np.median(np.diff(signal.t_ns))) * NS if count > 1 else 1.0
    length = max(_STILL_SAMPLES, round(_STILL_S / max(step, 1e-9)))
    return int(max(1, min(length, count * _STILL_MOST)))


def _undecided(message: str, recording: str, spans: Sequence[Span]) -> MissingAnswer:
    texts = [f"{recording}={NS * begin:.2f}:{NS * end:.2f}" for begin, end in spans]
    return MissingAnswer("no_contact", message, texts)


def _of_force(
    signal: Signal, pressing: Floats, recording: str, length: int, seen: Signal | None
) -> Span:
    t_ns, name = signal.t_ns, f"{recording}: {signal.name}"
    windows = np.lib.stride_tricks.sliding_window_view(pressing, length)
    mean, spread = windows.mean(axis=1), windows.std(axis=1)
    # A few samples far off, a glitch, are no part of the range.
    low, high = np.quantile(mean, (_GLITCH, 1.0 - _GLITCH))
    near = max(_AS_FREE * float(high - low), 3.0 * float(np.median(spread)))
    score = mean + 3 * spread
    order = np.sort(pressing)
    last = np.searchsorted(order, mean + near, side="right")
    lasts = last - np.searchsorted(order, mean - near) >= min(_LASTS * length, len(pressing) // 2)
    still = lasts & (spread <= 2.0 * near)
    lasting = next((each for each in (still, lasts) if each.any()), np.ones(len(mean), np.bool_))
    # Of spans that are about as free of force the first is the best: gel creeps after contact.
    least = float(score[lasting].min()) + near
    first = int(np.flatnonzero(lasting & (score <= least))[0])
    level, begins = float(mean[first]), float(mean[0])
    free, begin = _span(t_ns, first, length), _span(t_ns, 0, length)
    later = bool(lasting[0]) and begins - level > near
    if later and seen is not None and _alike(seen, begin, free):
        return begin
    _require_ends(name, pressing, mean[lasting])
    if not later:
        return free
    at_begin, at_level = (_stays(mean, each, near, length) for each in (begins, level))
    longer = sum(at_begin) > _LONGER * sum(at_level)
    if len(at_begin) > 1 and (longer or len(at_level) == 1):
        return begin
    if len(at_level) > 1:
        return free
    raise _undecided(
        f"{name}: it begins with {begins:.3g} N and presses least, {level:.3g} N, once, at "
        f"{NS * free[0]:.2f} s, and nothing tells which of them is without contact",
        recording,
        [begin, free],
    )


def _stays(mean: Floats, level: float, near: float, length: int) -> list[int]:
    """Return the numbers of samples of each stay near a level, by means over a span (n,)."""
    return [last + length - first for first, last in _runs(np.abs(mean - level) <= near)]


def _alike(seen: Signal, one: Span, other: Span) -> bool:
    """True if images or taxels of two spans differ by little of their largest change."""
    rows = [seen.rows[(seen.t_ns >= a) & (seen.t_ns < b)] for a, b in (one, other)]
    if not len(rows[0]) or not len(rows[1]):
        return False
    rest, there = (each.mean(axis=0) for each in rows)
    largest = float(np.abs(seen.rows - rest).mean(axis=1).max())
    noise = float(np.abs(rows[0] - rest).mean(axis=1).max())
    if largest <= _CLEAR * noise:
        return False  # they show no contact at all
    return float(np.abs(there - rest).mean()) < _SEEN_ALIKE * largest


def _require_ends(name: str, pressing: Floats, levels: Floats) -> None:
    """Reject forces that press most at both ends of a recording: the sign may be the other one.

    `levels` are the forces that last.
    """
    middle = float(levels.min() + levels.max()) / 2
    if pressing[0] > middle and pressing[-1] > middle:
        raise MissingAnswer(
            "no_contact",
            f"{name}: presses with {pressing[0]:.3g} and {pressing[-1]:.3g} N at the ends of the "
            f"recording and {levels.min():.3g} N between; a session has negative Fz under "
            "contact, so turn the sign of the file's forces, or, if it begins and ends in contact",
            ("START:END in seconds",),
        )


def find_presses(trace: Trace, no_contact: Span) -> list[Press]:
    """Return the contacts of at least `_PRESS_S` in a trace, in order of time."""
    t_ns, value = trace.t_ns, trace.value
    inside = (t_ns >= no_contact[0]) & (t_ns < no_contact[1])
    noise = float(value[inside].max()) if inside.any() else 0.0
    largest = float(value.max())
    if largest <= _CLEAR * max(noise, 1e-12):
        return []
    high = value > max(2 * noise, _BEGIN * largest)
    reach = value > max(1.2 * noise, _REACH * largest)
    presses: list[Press] = []
    for first, last in _runs(reach):
        if not high[first : last + 1].any():
            continue
        if presses and (t_ns[first] - presses[-1].end_ns) * NS < _GAP_S:
            before = presses.pop()
            first = int(np.searchsorted(t_ns, before.start_ns))
        presses.append(_press(t_ns, value, first, last))
    return [press for press in presses if (press.end_ns - press.start_ns) * NS >= _PRESS_S]


def press_within(trace: Trace, span: Span) -> Press:
    """Return the contact within a span that was stated [ns]."""
    inside = np.flatnonzero((trace.t_ns >= span[0]) & (trace.t_ns < span[1]))
    if len(inside) < 2:
        raise SessionError(
            f"--press: {NS * span[0]:.3f} to {NS * span[1]:.3f} s holds {len(inside)} samples"
        )
    return _press(trace.t_ns, trace.value, int(inside[0]), int(inside[-1]))


def widened(presses: Sequence[Press], start_ns: int, end_ns: int, by_ns: int) -> list[Press]:
    """Return presses with up to `by_ns` before and after each, which touch no other press."""
    middles = [(one.end_ns + two.start_ns) // 2 for one, two in pairwise(presses)]
    return [
        Press(max(press.start_ns - by_ns, low), press.peak_ns, min(press.end_ns + by_ns, high))
        for press, low, high in zip(presses, [start_ns, *middles], [*middles, end_ns], strict=True)
    ]


def _press(t_ns: Times, value: Floats, first: int, last: int) -> Press:
    peak = first + int(np.argmax(value[first : last + 1]))
    start, end = _span(t_ns, first, last + 1 - first)
    return Press(start, min(max(int(t_ns[peak]), start + 1), end - 1), end)


def _runs(high: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, high, False].astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


def _span(t_ns: Times, first: int, length: int) -> Span:
    """Return the time of a number of samples [ns], to the next one or the end."""
    after = first + length
    end = int(t_ns[after]) if after < len(t_ns) else int(t_ns[after - 1]) + 1
    return int(t_ns[first]), end
