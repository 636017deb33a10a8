"""Count and place the samples that a stream lost. Pure functions, numpy only.

A loss shows in three places, the best of which is used: the device's sequence numbers, its clock,
and the arrival at the host. The first two count exactly. Arrivals are first freed of
delays: a late sample that later ones catch up with is not lost. Everything is compared with the
declared rate; a median of what arrived would hide that every second sample is missing.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recorder.session.columns import Columns, Rows, Stream, blocks

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# What the counts of a stream are based on.
SEQUENCE, DEVICE_CLOCK, ARRIVAL, NOTHING = "sequence", "device clock", "arrival", "nothing"
# Source of a stream of events, which come at no rate and so miss none.
EVENTS = "events"

# A device's true rate may differ from the declared one by this fraction.
RATE_TOLERANCE = 0.02
# Slower than that by more than this fraction, a device sends fewer samples than it should.
SLOW = 0.03
# Received and lost samples of `RATE_WINDOW` [s] that deviate by more than this are another rate.
RATE_LIMIT, RATE_WINDOW = 0.15, 2.0
# A delayed sample is compared with those that arrive within this time after it [s].
HORIZON = 1.0
# A device's clock that gains more than this on the host's between two samples was set [s].
CLOCK_STEP = 1.0

_NS = 1e-9
_UNSURE = 5  # samples after a gap that tell a late sample from a lost one
_RARE = 0.3  # losses per sample; where there are more, those at the end are no surprise
_MOST = 1e15  # more samples than any device sends; keeps counts of nonsense in int64


@dataclass(frozen=True, slots=True)
class Losses:
    """Gaps in one run of a stream, in the order of time. Each lost at least one sample."""

    source: str
    """Basis of the counts: `SEQUENCE`, `DEVICE_CLOCK`, `ARRIVAL` or `NOTHING`."""
    row: NDArray[np.int64]
    """First row after each gap (g,), counted from the start of the run."""
    count: NDArray[np.int64]
    """Samples lost in each gap (g,)."""
    start_ns: Times
    """Time of the last sample before each gap (g,) [ns]."""
    end_ns: Times
    """Time of the first sample after each gap (g,) [ns]."""

    @classmethod
    def none(cls, source: str) -> Self:
        """Return no gap."""
        return cls(source, *(np.zeros(0, np.int64) for _ in range(4)))

    @property
    def total(self) -> int:
        """Number of lost samples."""
        return int(self.count.sum())

    @property
    def counted(self) -> bool:
        """True if the device itself tells of its losses, by its numbers or its clock."""
        return self.source in (SEQUENCE, DEVICE_CLOCK, EVENTS)

    def before(self, t_ns: Times) -> NDArray[np.int64]:
        """Return the number of samples lost before each time (n,); a gap lost them evenly."""
        done = np.concatenate([[0], np.cumsum(self.count)])
        gap = np.searchsorted(self.start_ns, t_ns, side="left") - 1
        inside = gap >= 0
        at = np.maximum(gap, 0)
        if not len(self.count):
            return np.zeros(len(t_ns), np.int64)
        width = np.maximum(self.end_ns[at] - self.start_ns[at], 1)
        fraction = (t_ns - self.start_ns[at]) / width * (self.count[at] + 1.0)
        part = np.clip(np.ceil(fraction) - 1, 0, self.count[at]).astype(np.int64)
        return np.where(inside, done[at] + part, 0)

    def around(self, t_ns: Times) -> Bools:
        """Return True where a sample was lost between the samples before and after a time (n,)."""
        if not len(self.count):
            return np.zeros(len(t_ns), np.bool_)
        gap = np.searchsorted(self.start_ns, t_ns, side="left") - 1
        return np.asarray((gap >= 0) & (t_ns < self.end_ns[np.maximum(gap, 0)]))

    def on(self, t_ns: Times) -> Losses:
        """Return the same gaps on other times of the rows (n,) [ns], such as their captures."""
        start, end = t_ns[self.row - 1], t_ns[self.row]
        order = np.argsort(start, kind="stable")
        start, end = start[order], np.maximum(start, end)[order]
        return Losses(self.source, self.row[order], self.count[order], start, end)

    def part(self, first: int, count: int) -> Losses:
        """Return the gaps between `count` rows from row `first` of the run on, counted from it."""
        low = np.searchsorted(self.row, first, side="right")
        kept = slice(low, np.searchsorted(self.row, first + count, side="left"))
        row, lost = self.row[kept] - first, self.count[kept]
        return Losses(self.source, row, lost, self.start_ns[kept], self.end_ns[kept])

    def inside(self, start_ns: Times, end_ns: Times) -> NDArray[np.int64]:
        """Return the number of samples lost in each interval [start, end) (n,)."""
        return self.before(end_ns) - self.before(start_ns)

    def touch(self, start_ns: Times, end_ns: Times) -> Bools:
        """Return True where a sample was lost in the interval [start, end] (n,)."""
        step = (self.end_ns - self.start_ns) / (self.count + 1.0)
        first = self.start_ns + np.round(step).astype(np.int64)
        last = self.end_ns - np.round(step).astype(np.int64)
        begun = np.searchsorted(first, end_ns, side="right")
        over = np.searchsorted(last, start_ns, side="left")
        return np.asarray(begun > over)


def find_losses(
    t_ns: Times | Rows,
    rate_hz: float,
    *,
    seq: NDArray[np.int64] | Rows | None = None,
    device_t: Floats | Rows | None = None,
    timed: bool = True,
) -> Losses:
    """Find the samples lost in one run of a stream, whose rows arrived at `t_ns` (n,) in order.

    With the device's sequence numbers (n,) and its own times (n,) [s], NaN where it gave none, if
    there are any. `timed` is false if the arrivals say nothing, as in a replay at another speed.
    """
    if len(t_ns) < 2:
        return Losses.none(SEQUENCE if seq is not None else ARRIVAL if timed else NOTHING)
    lost: Floats | None = None
    if seq is not None:
        clock = t_ns if timed else device_t
        span = np.nan if clock is None else float(clock[-1] - clock[0]) * (_NS if timed else 1.0)
        stride, found = _stride(seq, span, rate_hz), []
        for part in blocks(len(t_ns) - 1):
            times, own = (each[part.start : part.stop + 1] for each in (t_ns, seq))
            lost = _by_number(times, own, stride, rate_hz, timed)
            if np.isnan(lost).any():  # the other witnesses need the whole run
                lost = _by_number(t_ns[:], seq[:], stride, rate_hz, timed)
                break
            found.append(_gaps(part.start, lost, times))
        else:
            return Losses(SEQUENCE, *map(np.concatenate, zip(*found, strict=True)))
    times = t_ns[:]
    lost, source = _lost(times, rate_hz, lost, None if device_t is None else device_t[:], timed)
    return Losses(source, *_gaps(0, lost, times))


def numbers(rows: NDArray[Any], losses: Losses) -> NDArray[np.int64]:
    """Return the number of each row (n,) among all samples that the device sent."""
    before = np.concatenate([[0], np.cumsum(losses.count)])
    return np.asarray(rows + before[np.searchsorted(losses.row, rows, side="right")])


def lateness(
    t_ns: Times | Rows, rate_hz: float, losses: Losses, device_t: Floats | Rows | None = None
) -> tuple[Floats, float]:
    """Return how long each sample (n,) waited longer than the promptest around it (n,) [s].

    The second value is how far the promptest ones themselves wander within `HORIZON` [s].
    `device_t` (n,) [s] is given if the device's clock is usable.
    """
    if len(t_ns) < 2:
        return np.zeros(len(t_ns)), 0.0
    late, zero, parts = np.empty(len(t_ns)), t_ns[0], list(blocks(len(t_ns)))
    for part in parts:
        late[part] = (t_ns[part] - zero) * _NS
    period = _period(late, partial(numbers, losses=losses), rate_hz)
    clock = device_t
    if clock is not None and not all(np.isfinite(clock[part]).all() for part in parts):
        clock = None

    def due(first: int, stop: int) -> Floats:
        if clock is not None:
            return np.asarray(clock[first:stop] - clock[0])
        return np.asarray(numbers(np.arange(first, stop), losses) * period)

    steps = []  # of either clock are no delay: begin again after it
    for part in parts:
        moments = due(part.start, min(part.stop + 1, len(late)))
        late[part] -= moments[: part.stop - part.start]
        steps += (part.start + 1 + np.flatnonzero(np.diff(moments) <= 0)).tolist()
    wander = [_lift(late, due, *ends) for ends in pairwise([0, *steps, len(late)])]
    return late, max(wander)


def other_rate(
    t_ns: Times | Rows, rate_hz: float, losses: Losses
) -> tuple[int, float, float] | None:
    """Return where a device ran at another rate than declared: row, duration [s], rate [Hz].

    Lost samples count as sent. The longest stretch is returned, None if there is none, or if the
    times run backward.
    """
    count, size = len(t_ns), max(round(RATE_WINDOW * rate_hz), 8)
    if count <= size or any(
        np.any(np.diff(t_ns[part.start : part.stop + 1]) < 0) for part in blocks(count)
    ):
        return None
    zero = t_ns[0]

    def arrived(first: int, stop: int) -> Floats:
        return np.asarray((t_ns[first:stop] - zero) * _NS)

    def number(first: int, stop: int) -> NDArray[np.int64]:
        return numbers(np.arange(first, stop), losses)

    ratio = _promptest(arrived, lambda *ends: number(*ends) / rate_hz, count)
    wrong = np.zeros(count - size + 2, np.bool_)
    for part in blocks(count - size):
        begin, end = ((part.start + more, part.stop + more) for more in (0, size))
        sent = number(*end) - number(*begin)
        span = number(*end) / rate_hz + ratio[slice(*end)]
        span -= number(*begin) / rate_hz + ratio[part]
        ratio[part] = sent / np.maximum(span * rate_hz, 1e-9)  # no later part needs its delays
        wrong[1:-1][part] = np.abs(ratio[part] - 1) > RATE_LIMIT
    edges = np.flatnonzero(np.diff(wrong)).reshape(-1, 2)
    if not len(edges):
        return None
    first, last = max(edges.tolist(), key=lambda edge: edge[1] - edge[0])
    worst = first + int(np.abs(ratio[first:last] - 1).argmax())
    last = last - 1 + size
    lasted = arrived(last, last + 1)[0] - arrived(first, first + 1)[0]
    return first, float(lasted), float(ratio[worst] * rate_hz)


def _gaps(first: int, lost: Floats, t_ns: Times) -> tuple[NDArray[np.int64], ...]:
    """Return the fields of `Losses` after its source, of rows (n,) from row `first` on."""
    gaps = np.flatnonzero(lost > 0)
    count = np.minimum(lost[gaps], _MOST).astype(np.int64)
    return first + gaps + 1, count, t_ns[gaps], np.maximum(t_ns[gaps + 1], t_ns[gaps])


def _by_number(
    t_ns: Times, seq: NDArray[np.int64], stride: int, rate_hz: float, timed: bool
) -> Floats:
    """Return the samples lost before each row but the first (n - 1,); NaN if it began again."""
    step = np.diff(seq)
    missing = np.maximum(step // stride - 1.0, 0.0)
    unusable = step < 0
    if timed:
        passed = np.diff((t_ns - t_ns[0]) * _NS)
        unusable |= missing > 2 * rate_hz * (passed + CLOCK_STEP)
    missing[unusable] = np.nan
    return missing


def _lost(
    t_ns: Times, rate_hz: float, numbered: Floats | None, device_t: Floats | None, timed: bool
) -> tuple[Floats, str]:
    """Return the samples lost before each row but the first (n - 1,), and the witness.

    `numbered` are those by the device's numbers, if it has any.
    """
    arrived = (t_ns - t_ns[0]) * _NS
    passed = np.diff(arrived)
    source = NOTHING if numbered is None else SEQUENCE
    # NaN where no witness has spoken yet.
    lost = np.full(len(passed), np.nan) if numbered is None else numbered
    silent = np.isnan(lost)
    if silent.any() and device_t is not None and np.isfinite(device_t).sum() > 1:
        source = source if numbered is not None else DEVICE_CLOCK
        step = np.diff(np.asarray(device_t, np.float64))
        usable = np.isfinite(step) & (step > 0)
        if timed:
            usable &= step < passed + CLOCK_STEP
        at = np.concatenate([[0.0], np.cumsum(np.where(usable, step, 1.0 / rate_hz))])
        usable &= silent
        lost[usable] = _by_clock(at, rate_hz, delayed=False)[usable]
    silent = np.isnan(lost)
    if silent.any() and timed:
        source = ARRIVAL if source == NOTHING else source
        lost[silent] = _by_clock(arrived, rate_hz, delayed=True)[silent]
    return np.nan_to_num(lost), source


def _by_clock(at: Floats, rate_hz: float, *, delayed: bool) -> Floats:
    """Return the samples lost before each row but the first (n - 1,), by a clock's times (n,) [s].

    Samples that may be `delayed` are first freed of it.
    """
    rows = np.arange(len(at))
    period = 1.0 / rate_hz
    lost = np.zeros(len(at) - 1)
    # Losses lengthen the measured period, so it is refined once they are known.
    for _ in range(3):
        prompt = _prompt(at, np.asarray(rows * period, np.float64)) if delayed else at
        lost = _missing(np.diff(prompt), period)
        number = rows + np.concatenate([[0], np.cumsum(lost)])
        period = _period(at, number.__getitem__, rate_hz)
    if delayed:
        # Too few samples after the last gaps tell if one was lost, or the next was only late.
        end, before = lost[-_UNSURE:], lost[-4 * _UNSURE : -_UNSURE]
        if len(before) and before.mean() < _RARE:
            end[end <= 2] = 0
    return lost


def _stride(seq: NDArray[np.int64] | Rows, span: float, rate_hz: float) -> int:
    """Return the step of the numbers (n,) of consecutive samples.

    It is 1, unless all steps have a common divisor and the samples came at the declared rate in
    `span`, from the first to the last [s]; NaN if no clock tells.
    """
    divisor = 0
    for part in blocks(len(seq) - 1):
        steps = np.diff(seq[part.start : part.stop + 1])
        if (divisor := int(np.gcd.reduce(steps, initial=divisor))) == 1:
            return 1
    sent = (int(seq[-1]) - int(seq[0])) / max(divisor, 1)
    if divisor <= 1 or span <= 0:
        return 1
    other = abs(sent / (span * rate_hz) - 1) >= RATE_LIMIT
    return 1 if other else divisor


def _period(at: Floats, number: Callable[[Any], NDArray[Any]], rate_hz: float) -> float:
    """Return the period [s]: the declared one, refined within `RATE_TOLERANCE` by what came.

    It is measured between the promptest samples of each `HORIZON`. Losses only lengthen it, so the
    shorter stretches decide. `number` gives the numbers of rows.
    """
    declared = period = 1.0 / rate_hz
    size = max(round(rate_hz * HORIZON), 16)
    if len(at) < 3 * size:
        return declared
    starts = np.arange(0, len(at) - size + 1, size)
    for _ in range(2):
        prompt = starts + [
            (at[start : start + size] - number(np.arange(start, start + size)) * period).argmin()
            for start in starts.tolist()
        ]
        steps = np.maximum(np.diff(number(prompt)), 1)
        measured = float(np.quantile(np.diff(at[prompt]) / steps, 0.25))
        low, high = declared * (1 - RATE_TOLERANCE), declared * (1 + RATE_TOLERANCE)
        period = min(max(measured, low), high)
    return period


def _prompt(arrived: Floats, due: Floats) -> Floats:
    """Return arrivals without the delays that later samples caught up with (n,) [s].

    A sample that was sent on time arrived at the latest when a later one shows it was due.
    """
    arrived_in, due_in = (lambda first, stop, of=each: of[first:stop] for each in (arrived, due))
    return np.asarray(due + _promptest(arrived_in, due_in, len(due)))


def _promptest(
    arrived: Callable[[int, int], Floats], due: Callable[[int, int], Floats], count: int
) -> Floats:
    """Return how much later than due each of `count` samples came at the least (n,) [s].

    `arrived` and `due` give the times of rows [first, stop) [s].
    """
    zero = due(0, 1)[0]
    size = max(bisect_left(range(count), HORIZON, key=lambda k: due(k, k + 1)[0] - zero), 2)
    offset = np.empty(count)
    for part in blocks(count):
        ends = part.start, min(part.stop + size, count)
        offset[part] = _least_ahead(arrived(*ends) - due(*ends), size)[: part.stop - part.start]
    # A run that ends while samples still come in a burst has none that shows the rest was on time.
    last = count - 1
    tail = bisect_right(range(count), 1e-9, key=lambda k: offset[-1] - offset[last - k])
    first = count - tail
    if 0 < first < last:
        came, wanted = (each(last, count) - each(first, first + 1) for each in (arrived, due))
        if came < 0.5 * wanted:
            offset[first:] = min(offset[first - 1], offset[-1])
    return offset


def _least_ahead(values: Floats, size: int) -> Floats:
    """Return the least of each value and those up to `size` after it (n,)."""
    count = -(-len(values) // size) * size
    padded = np.concatenate([values, np.full(count + size - len(values), np.inf)])
    blocks = padded.reshape(-1, size)
    from_start = np.minimum.accumulate(blocks, axis=1).reshape(-1)
    to_end = np.minimum.accumulate(blocks[:, ::-1], axis=1)[:, ::-1].reshape(-1)
    n = len(values)
    return np.asarray(np.minimum(to_end[:n], from_start[size : n + size]))


def _missing(steps: Floats, period: float) -> Floats:
    """Return the samples missing in each step (n,).

    The fraction of a period that rounding leaves is added to the next step, so that steps of one
    and a half periods each lose every third sample. It fades, so that a rate within `SLOW` of the
    declared one loses none.
    """
    beyond = np.minimum(np.maximum(steps, 0.0) / period, _MOST) - 1.0
    lost = np.zeros(len(beyond))
    # No remainder exceeds that of steps summed up from any earlier one.
    sums = np.cumsum(beyond - SLOW)
    if (sums - np.minimum.accumulate(np.minimum(sums, 0.0))).max() + SLOW <= 0.5:
        return lost
    remainder = 0.0
    for index, value in enumerate(beyond.tolist()):
        remainder += value
        if remainder > 0.5:
            lost[index] = whole = math.floor(remainder + 0.5)
            remainder -= whole
        # Less than a period early is all that a delay before it can explain.
        remainder = (
            max(remainder - SLOW, 0.0) if remainder > 0 else max(min(remainder + SLOW, 0.0), -1.0)
        )
    return lost


def _lift(late: Floats, due: Callable[[int, int], Floats], first: int, stop: int) -> float:
    """Lower offsets in rows [first, stop) [s] by the least around each; return how far it moves."""
    zero, starts = due(first, first + 1)[0], [first]
    for part in blocks(stop - first - 1):
        moments = due(first + part.start, first + part.stop + 1)
        number = np.floor((moments - zero) / HORIZON).astype(np.int64)
        starts += (first + part.start + 1 + np.flatnonzero(np.diff(number) > 0)).tolist()
    least = np.minimum.reduceat(late[:stop], starts)
    around = np.minimum(least, np.minimum(np.r_[least[1:], np.inf], np.r_[np.inf, least[:-1]]))
    for ends, low in zip(pairwise([*starts, stop]), around.tolist(), strict=True):
        late[slice(*ends)] = np.maximum(late[slice(*ends)] - low, 0.0)
    return float(np.quantile(np.abs(np.diff(least)), 0.75)) if len(least) > 1 else 0.0


def is_regular(stream: Columns) -> bool:
    """Return False for events, which come at no rate: their last sample holds for any time."""
    return stream.traits.defaults.max_age != math.inf


def witnesses(stream: Stream, rows: slice) -> dict[str, Any]:
    """Return the arguments `seq` and `device_t` of `find_losses`, as far as they can be trusted.

    Attribute `numbering` of a stream, or of its device, is `host` if `seq` was counted at the
    host: such numbers miss what never arrived.
    """
    arguments: dict[str, Any] = {}
    attrs = {**stream.attrs.get("device", {}), **stream.attrs}
    if "seq" in stream.names and attrs.get("numbering", "device") != "host":
        arguments["seq"] = stream.rows("seq", rows)
    if "device_t" in stream.names:
        device_t = stream.rows("device_t", rows)
        if any(np.isfinite(device_t[part]).any() for part in blocks(len(device_t))):
            arguments["device_t"] = device_t
    return arguments


def stream_losses(stream: Stream, rows: slice, *, timed: bool = True) -> Losses:
    """Return the losses in some rows of one run; an irregular stream shows none."""
    if not is_regular(stream):
        return Losses.none(EVENTS)
    t_ns = stream.rows("t_ns", rows)
    return find_losses(t_ns, stream.rate_hz, timed=timed, **witnesses(stream, rows))


def is_compressed(attrs: Mapping[str, Any]) -> bool:
    """Return True if a session's times come from a replay at a speed other than the recorded one.

    Such times still give the order, but not pauses or steps against the device's clock.
    """
    return bool(attrs.get("replay_of", {}).get("speed", 1.0) != 1.0)


_SHOWN = 5  # targets named in a line


@dataclass(frozen=True, slots=True)
class Account:
    """Samples of one stream that a session has, and those that it lost."""

    rows: int
    """Samples stored."""
    measured_hz: float
    """Rate over the time that was recorded; pauses between runs do not count."""
    longest_gap: float
    """Longest time between two samples of a run [s]."""
    runs: tuple[Losses, ...]
    """Losses of each run."""
    by_target: Mapping[int, int]
    """Samples lost in the phases of each target, of those that lost some."""

    @property
    def lost(self) -> int:
        """Number of lost samples."""
        return sum(losses.total for losses in self.runs)

    @property
    def gaps(self) -> int:
        """Number of gaps."""
        return sum(len(losses.count) for losses in self.runs)

    @property
    def source(self) -> str:
        """Basis of the counts; the least exact of the runs."""
        rising_exactness = (NOTHING, ARRIVAL, DEVICE_CLOCK, SEQUENCE, EVENTS)
        return min(
            (losses.source for losses in self.runs), key=rising_exactness.index, default=NOTHING
        )

    @property
    def sees_drops(self) -> bool:
        """True if the device itself tells of each loss, by its numbers or its clock."""
        return all(losses.counted for losses in self.runs)

    def targets_text(self) -> str:
        """Return the targets that lost samples as text, worst first; targets count from 1."""
        if not self.lost:
            return ""
        worst = sorted(self.by_target.items(), key=lambda item: (-item[1], item[0]))
        parts = [f"target {target + 1} ({count})" for target, count in worst[:_SHOWN]]
        if len(worst) > _SHOWN:
            rest = sum(count for _, count in worst[_SHOWN:])
            parts.append(f"{len(worst) - _SHOWN} more targets ({rest})")
        outside = self.lost - sum(self.by_target.values())
        if outside:
            parts.append(f"outside of phases ({outside})")
        return ", ".join(parts)


def account_of(
    stream: Stream, rows: Sequence[slice], runs: Sequence[Losses], by_target: Mapping[int, int]
) -> Account:
    """Return the account of a stream, of its rows and losses of each run."""
    steps, seconds, longest = 0, 0.0, 0.0
    for rows_of_run in rows:
        t_ns = stream.rows("t_ns", rows_of_run)
        if len(t_ns) > 1:
            steps += len(t_ns) - 1
            seconds += max(int(t_ns[-1]) - int(t_ns[0]), 1) * _NS
            for part in blocks(len(t_ns) - 1):
                most = np.diff(t_ns[part.start : part.stop + 1]).max()
                longest = max(longest, float(most) * _NS)
    rate = steps / seconds if seconds else 0.0
    return Account(len(stream), rate, longest, tuple(runs), by_target)


def loss_lines(accounts: Mapping[str, Account]) -> list[str]:
    """Return a line on the losses of each stream that lost samples, or whose drops are unseen."""
    lines = []
    for name, account in accounts.items():
        if account.lost:
            lines.append(
                f"lost         {name}: {account.lost} samples in {account.gaps} places, counted "
                f"by {account.source}; {account.targets_text()}"
            )
        if not account.sees_drops and account.rows:
            lines.append(f"note         {name}: {unseen(account)}")
    return lines


def unseen(account: Account) -> str:
    """Return a note for a stream whose device does not report its losses."""
    if account.source == ARRIVAL:
        return (
            "drops are inferred from arrivals and the declared rate: the device numbers no samples"
        )
    return "drops cannot be seen: the device gives neither numbers nor usable times"
