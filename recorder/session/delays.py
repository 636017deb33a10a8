"""When a stream shows a press, beside the arm's way into the skin.

Forces and pictures follow the indentation. In each press, the delay is found at which a signal is
best described by the depth and its square, on the way down and up: what depends on the direction,
such as a surface that is lower than stated, has opposite effects on the two, whose mean is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorder.session.align import NS, captured
from recorder.session.columns import Stream, StreamPart
from recorder.session.presses import DEEP, DOWN, UP, Phase, Presses
from recorder.session.small_pictures import reference_rows, rms, small_size, smaller

Floats = NDArray[np.float64]
Level = Callable[[range], Floats]

# Delays that are tried [s]; time around a phase that is looked at [s], and at least three periods;
# most samples of a phase, and fewest; and how much of a signal the depth must explain.
DELAYS, AROUND, MOST, FEWEST, EXPLAINED = np.arange(-0.4, 0.401, 0.01), 0.1, 60, 6, 0.98


class PressDelay(NamedTuple):
    """Delay of a stream in one press."""

    target: int
    """Index of the target."""
    t_ns: int
    """When the press began [ns]."""
    delay: float
    """Time by which the stream is behind the arm [s]; NaN if it cannot be told."""
    left: Floats
    """Spread of the signal that the depth does not explain, at each of `DELAYS` (d,)."""
    spread: Floats
    """Spread of the signal on both ways (2,)."""


def press_delays(
    presses: Presses, stream: Stream, level: Level, phases: Sequence[Phase]
) -> list[PressDelay]:
    """Return the delay of a stream in each of some presses.

    `level` returns the signal (n,) in a range of rows: 0 without contact, and larger the deeper the
    tip is. Presses in which it is NaN are left out. `phases` are both ways of each press.
    """
    by_press: dict[tuple[int, int], dict[int, Phase]] = {}
    for one in phases:
        by_press.setdefault((one.run, one.target), {})[one.code] = one
    found = []
    for of_press in by_press.values():
        if {DOWN, UP} <= {*of_press}:
            with np.errstate(all="ignore"):  # values may be impossible ones
                both = [_delay(presses, of_press[code], stream, level) for code in (DOWN, UP)]
            delay, spread, left = map(np.array, zip(*both, strict=True))
            if np.isfinite(spread).all():
                down, worst = of_press[DOWN], left.max(axis=0)
                found.append(
                    PressDelay(down.target, down.start, float(delay.mean()), worst, spread)
                )
    return found


def timed_phases(presses: Presses) -> list[Phase]:
    """Return the ways down and up of the presses that are deep enough to tell a delay."""
    return [
        one
        for one in presses.phases
        if one.whole and one.code in (DOWN, UP) and presses.planned("depth", one.target) >= DEEP
    ]


def beyond_noise(moved: NDArray[np.floating]) -> Level:
    """Return the level by a change (n,), which is less, in squares, that of the noise at rest.

    Rows whose change is not known are NaN.
    """
    known = moved[np.isfinite(moved)]
    noise = float(np.quantile(known, 0.02)) if known.size else 0.0
    size = np.sqrt(np.maximum(np.square(moved, dtype=np.float64) - noise**2, 0.0))
    return lambda rows: size[rows.start : rows.stop : rows.step]


def force_level(presses: Presses) -> Level:
    """Return the level by the gauge: its compression, else its largest force [N]."""
    axes = presses.forces

    def level(rows: range) -> Floats:
        values = presses.values(rows.start, rows.stop)[:: rows.step]
        return -values[:, 2] if 2 in axes else np.abs(values[:, axes]).max(axis=1)

    return level


def picture_level(presses: Presses, stream: Stream, phases: Sequence[Phase]) -> Level | None:
    """Return the level by the pictures in some phases, which are decoded; None without reference.

    It is the difference from the pictures without contact [grey levels].
    """
    resting = reference_rows(presses.session, stream.name)
    if not resting or min(small_size(stream)) < FEWEST:
        return None
    reference = smaller(stream, resting, {})[0].mean(axis=0)
    moved = np.full(len(stream), np.nan)
    for one in phases:
        rows = _rows(presses, one, stream)
        if len(rows):
            moved[rows.start : rows.stop : rows.step] = rms(
                smaller(stream, rows, {})[0] - reference
            )
    return beyond_noise(moved) if np.isfinite(moved).any() else None


def _rows(presses: Presses, one: Phase, stream: Stream) -> range:
    """Return at most some `MOST` rows of a stream in a phase, and a little around it."""
    around = round(max(AROUND, 3 / stream.rate_hz) / NS)
    end = one.end + around * (one.code == UP)
    rows = presses.rows(stream, one.run, one.start - around, end)
    return rows[:: max(1, len(rows) // MOST)]


def _delay(
    presses: Presses, one: Phase, stream: Stream, level: Level
) -> tuple[float, float, Floats]:
    """Return delay, spread and rest of a signal in one phase, as those of `PressDelay`."""
    moments, places = presses.places(one.run)
    rows, delay = _rows(presses, one, stream), float("nan")
    if rows.stop - rows.start < FEWEST or len(moments) < 2:
        return delay, delay, DELAYS
    times = captured(StreamPart(stream, rows.start, rows.stop))[:: rows.step]
    value = level(rows)
    value = value - value.mean()
    depth = 1e3 * (presses.height(one.target) - places[:, 2])
    at = (times - one.start) * NS - DELAYS[:, None]
    inside = np.maximum(np.interp(at, (moments - one.start) * NS, depth), 0.0)
    basis = np.stack([inside, inside**2], axis=-1)
    basis -= basis.mean(axis=1, keepdims=True)
    gram = basis.transpose(0, 2, 1) @ basis + 1e-9 * np.eye(2)
    fitted = (basis.transpose(0, 2, 1) @ value)[..., None]
    size = max(float(value @ value), 1e-12)
    explained = (fitted * np.linalg.solve(gram, fitted)).sum(axis=(1, 2)) / size
    explained[fitted[:, 0, 0] <= 0] = 0.0  # a signal rises with the depth
    best = int(explained.argmax())
    if explained[best] > EXPLAINED and 0 < best < len(DELAYS) - 1:
        low, middle, high = explained[best - 1 : best + 2]
        step = 0.5 * (DELAYS[1] - DELAYS[0])
        delay = float(DELAYS[best] + step * (low - high) / (low - 2 * middle + high))
    spread = float(np.sqrt(size / len(value)))
    return delay, spread, spread * np.sqrt(np.maximum(1 - explained, 0.0))
