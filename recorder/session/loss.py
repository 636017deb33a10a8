"""Count and place the samples that a stream lost. Pure functions, numpy only.

A loss shows in three places, the best of which is used: the device's sequence numbers, its clock,
and the arrival at the host. The first two count exactly. Arrivals are first freed of
delays: a late sample that later ones catch up with is not lost. Everything is compared with the
declared rate; a median of what arrived would hide that every second sample is missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recorder.session.columns import Columns, Stream

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
        if not len(self.count):
            return np.zeros(len(start_ns), np.bool_)
        step = (self.end_ns - self.start_ns) / (self.count + 1.0)
        first = self.start_ns + np.round(step).astype(np.int64)
        last = self.end_ns - np.round(step).astype(np.int64)
        begun = np.searchsorted(first, end_ns, side="right")
        over = np.searchsorted(last, start_ns, side="left")
        return np.asarray(begun > over)


def find_losses(
    t_ns: Times,
    rate_hz: float,
    *,
    seq: NDArray[np.int64] | None = None,
    device_t: Floats | None = None,
    timed: bool = True,
) -> Losses:
    """Find the samples lost in one run of a stream, whose rows arrived at `t_ns` (n,) in order.

    With the device's sequence numbers (n,) and its own times (n,) [s], NaN where it gave none, if
    there are any. `timed` is false if the arrivals say nothing, as in a replay at another speed.
    """
    if len(t_ns) < 2:
        return Losses.none(SEQUENCE if seq is not None else ARRIVAL if timed else NOTHING)
    lost, source = _lost(t_ns, rate_hz, seq, device_t, timed)
    gaps = np.flatnonzero(lost > 0)
    count = np.minimum(lost[gaps], _MOST).astype(np.int64)
    return Losses(source, gaps + 1, count, t_ns[gaps], np.maximum(t_ns[gaps + 1], t_ns[gaps]))


def numbers(count: int, losses: Losses) -> NDArray[np.int64]:
    """Return the number of each of `count` rows among all samples that the device sent."""
    lost = np.zeros(count, np.int64)
    lost[losses.row] = losses.count
    return np.arange(count, dtype=np.int64) + np.cumsum(lost)


def lateness(
    t_ns: Times, rate_hz: float, losses: Losses, device_t: Floats | None = None
) -> tuple[Floats, float]:
    """Return how long each sample (n,) waited longer than the promptest around it (n,) [s].

    The second value is how far the promptest ones themselves wander within `HORIZON` [s].
    `device_t` (n,) [s] is given if the device's clock is usable.
    """
    if len(t_ns) < 2:
        return np.zeros(len(t_ns)), 0.0
    arrived = (t_ns - t_ns[0]) * _NS
    number = numbers(len(t_ns), losses)
    due = np.asarray(number * _period(arrived, number, rate_hz), np.float64)
    if device_t is not None and np.isfinite(device_t).all():
        due = device_t - device_t[0]
    offset = arrived - due
    # A step of either clock is no delay: begin again after it.
    parts = np.split(np.arange(len(offset)), np.flatnonzero(np.diff(due) <= 0) + 1)
    late, wander = np.zeros(len(offset)), 0.0
    for part in parts:
        late[part], moved = _above_least(offset[part], due[part])
        wander = max(wander, moved)
    return late, wander


def other_rate(t_ns: Times, rate_hz: float, losses: Losses) -> tuple[int, float, float] | None:
    """Return where a device ran at another rate than declared: row, duration [s], rate [Hz].

    Lost samples count as sent. The longest stretch is returned, None if there is none, or if the
    times run backward.
    """
    arrived = (t_ns - t_ns[0]) * _NS if len(t_ns) else np.zeros(0)
    number = numbers(len(t_ns), losses)
    size = max(round(RATE_WINDOW * rate_hz), 8)
    if len(t_ns) <= size or np.any(np.diff(t_ns) < 0):
        return None
    prompt = _prompt(arrived, number / rate_hz)
    span = prompt[size:] - prompt[:-size]
    sent = number[size:] - number[:-size]
    ratio = sent / np.maximum(span * rate_hz, 1e-9)
    wrong = np.concatenate([[False], np.abs(ratio - 1) > RATE_LIMIT, [False]])
    edges = np.flatnonzero(np.diff(wrong.astype(np.int8))).reshape(-1, 2)
    if not len(edges):
        return None
    first, last = max(edges.tolist(), key=lambda edge: edge[1] - edge[0])
    last = last - 1 + size
    worst = first + int(np.abs(ratio[first : last + 1 - size] - 1).argmax())
    return first, float(arrived[last] - arrived[first]), float(ratio[worst] * rate_hz)


def _lost(
    t_ns: Times, rate_hz: float, seq: NDArray[np.int64] | None, device_t: Floats | None, timed: bool
) -> tuple[Floats, str]:
    """Return the samples lost before each row but the first (n - 1,), and the witness."""
    arrived = (t_ns - t_ns[0]) * _NS
    passed = np.diff(arrived)
    source = NOTHING
    lost = np.full(len(passed), np.nan)  # where no witness has spoken yet
    if seq is not None:
        source = SEQUENCE
        step = np.diff(seq)
        span = float(arrived[-1]) if timed else float("nan")
        if not timed and device_t is not None:
            span = float(device_t[-1] - device_t[0])
        missing = np.maximum(step // _stride(seq, span, rate_hz) - 1.0, 0.0)
        usable = step >= 0  # else the device began to count again
        if timed:
            usable &= missing <= 2 * rate_hz * (passed + CLOCK_STEP)
        lost[usable] = missing[usable]
    silent = np.isnan(lost)
    if silent.any() and device_t is not None and np.isfinite(device_t).sum() > 1:
        source = source if seq is not None else DEVICE_CLOCK
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
        period = _period(at, rows + np.concatenate([[0], np.cumsum(lost)]), rate_hz)
    if delayed:
        # Too few samples after the last gaps tell if one was lost, or the next was only late.
        end, before = lost[-_UNSURE:], lost[-4 * _UNSURE : -_UNSURE]
        if len(before) and before.mean() < _RARE:
            end[end <= 2] = 0
    return lost


def _stride(seq: NDArray[np.int64], span: float, rate_hz: float) -> int:
    """Return the step of the numbers (n,) of consecutive samples.

    It is 1, unless all steps have a common divisor and the samples came at the declared rate in
    `span`, from the first to the last [s]; NaN if no clock tells.
    """
    divisor = int(np.gcd.reduce(np.diff(seq)))
    sent = (int(seq[-1]) - int(seq[0])) / max(divisor, 1)
    if divisor <= 1 or span <= 0:
        return 1
    other = abs(sent / (span * rate_hz) - 1) >= RATE_LIMIT
    return 1 if other else divisor


def _period(at: Floats, number: NDArray[Any], rate_hz: float) -> float:
    """Return the period [s]: the declared one, refined within `RATE_TOLERANCE` by what came.

    It is measured between the promptest samples of each `HORIZON`. Losses only lengthen it, so the
    shorter stretches decide.
    """
    declared = period = 1.0 / rate_hz
    size = max(round(rate_hz * HORIZON), 16)
    if len(at) < 3 * size:
        return declared
    starts = np.arange(0, len(at) - size + 1, size)
    for _ in range(2):
        offset = at - number * period
        prompt = np.array([start + offset[start : start + size].argmin() for start in starts])
        steps = np.maximum(np.diff(number[prompt]), 1)
        measured = float(np.quantile(np.diff(at[prompt]) / steps, 0.25))
        low, high = declared * (1 - RATE_TOLERANCE), declared * (1 + RATE_TOLERANCE)
        period = min(max(measured, low), high)
    return period


def _prompt(arrived: Floats, due: Floats) -> Floats:
    """Return arrivals without the delays that later samples caught up with (n,) [s].

    A sample that was sent on time arrived at the latest when a later one shows it was due.
    """
    size = max(int(np.searchsorted(due - due[0], HORIZON)), 2)
    offset = _least_ahead(arrived - due, size)
    # A run that ends while samples still come in a burst has none that shows the rest was on time.
    tail = int(np.searchsorted(-np.flip(offset - offset[-1]), 1e-9, side="right"))
    first = len(due) - tail
    hurried = arrived[-1] - arrived[first] < 0.5 * (due[-1] - due[first])
    if 0 < first < len(due) - 1 and hurried:
        offset[first:] = min(offset[first - 1], offset[-1])
    return np.asarray(due + offset)


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


def _above_least(offset: Floats, due: Floats) -> tuple[Floats, float]:
    """Return each offset above the least around it (n,) [s], and how far the least moves [s]."""
    block = np.floor((due - due[0]) / HORIZON).astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(block) > 0]))
    least = np.minimum.reduceat(offset, starts)
    around = np.minimum(least, np.minimum(np.r_[least[1:], np.inf], np.r_[np.inf, least[:-1]]))
    sizes = np.diff(np.r_[starts, len(offset)])
    moved = float(np.quantile(np.abs(np.diff(least)), 0.75)) if len(least) > 1 else 0.0
    return np.maximum(offset - np.repeat(around, sizes), 0.0), moved


# Losses of recorded streams.


def is_regular(stream: Columns) -> bool:
    """Return False for events, which come at no rate: their last sample holds for any time."""
    return stream.traits.defaults.max_age != math.inf


def witnesses(stream: Columns, rows: slice) -> dict[str, Any]:
    """Return the arguments `seq` and `device_t` of `find_losses`, as far as they can be trusted.

    Attribute `numbering` of a stream, or of its device, is `host` if `seq` was counted at the
    host: such numbers miss what never arrived.
    """
    arguments: dict[str, Any] = {}
    attrs = {**stream.attrs.get("device", {}), **stream.attrs}
    if "seq" in stream.names and attrs.get("numbering", "device") != "host":
        arguments["seq"] = stream.array("seq")[rows]
    if "device_t" in stream.names:
        device_t = np.asarray(stream.array("device_t")[rows], np.float64)
        if np.isfinite(device_t).any():
            arguments["device_t"] = device_t
    return arguments


def stream_losses(stream: Columns, rows: slice, *, timed: bool = True) -> Losses:
    """Return the losses in some rows of one run; an irregular stream shows none."""
    t_ns = stream.t_ns[rows]
    if not is_regular(stream):
        return Losses.none(EVENTS)
    return find_losses(t_ns, stream.rate_hz, timed=timed, **witnesses(stream, rows))


def is_compressed(attrs: Mapping[str, Any]) -> bool:
    """Return True if a session's times come from a replay at a speed other than the recorded one.

    Such times still give the order, but not pauses or steps against the device's clock.
    """
    return bool(attrs.get("replay_of", {}).get("speed", 1.0) != 1.0)


# Account of the samples that a session has of a stream, and of those that it lost.

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
        t_ns = stream.t_ns[rows_of_run]
        if len(t_ns) > 1:
            steps += len(t_ns) - 1
            seconds += max(int(t_ns[-1]) - int(t_ns[0]), 1) * _NS
            longest = max(longest, float(np.diff(t_ns).max()) * _NS)
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
