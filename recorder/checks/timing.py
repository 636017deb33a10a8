"""Witness of times: when a gauge or a sensor shows a press, beside the arm's way into the skin.

Forces and pictures follow the indentation. In each press, the delay is found at which a signal is
best described by the depth and its square, on the way down and up: what depends on the direction,
such as a surface that is lower than stated, has opposite effects on the two, whose mean is taken.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from recorder.checks.presses import DEEP, DOWN, UP, Phase, Presses
from recorder.checks.testimony import Testimony, most
from recorder.session.align import NS, captured
from recorder.session.columns import Stream
from recorder.session.uncertainty import time_sigma

Floats = NDArray[np.float64]

# Delays that are tried [s]; time around a phase that is looked at [s]; most samples of a phase, and
# fewest; and how much of a signal the depth must explain.
DELAYS, AROUND, MOST, FEWEST, EXPLAINED = np.arange(-0.4, 0.401, 0.01), 0.1, 60, 6, 0.98
# Standard deviations of the stated times that a delay may have, besides one frame, and the longest
# frame [s]; and scatters of the delays of a session that a single press may have as well.
SIGMAS, FRAME, SCATTERS = 3.0, 1 / 30, 4.0


def timing(presses: Presses, stream: Stream, level: Floats) -> Iterator[Testimony]:
    """Yield the testimony about the times of a stream whose samples have a level (n,).

    The level is 0 without contact, and rises with the indentation; of one that holds NaN, nothing
    is said.
    """
    session, name = presses.session, stream.name
    if not np.isfinite(level).all():
        return
    times = captured(stream)
    delays: list[float] = []
    found: list[int] = []
    by_press: dict[tuple[int, int], dict[int, float]] = {}
    for one in presses.phases:
        if one.whole and one.code in (DOWN, UP) and presses.planned("depth", one.target) >= DEEP:
            rows = session.rows_of_run(name, one.run)
            delay = _delay(presses, one, times[rows], level[rows])
            by_press.setdefault((one.run, one.target), {})[one.code] = delay
    for (_run, target), of_press in by_press.items():
        both = [of_press.get(code, np.nan) for code in (DOWN, UP)]
        if np.isfinite(both).all():
            delays.append(float(np.mean(both)))
            found.append(target)
    if len(delays) < 2:
        return
    stated = time_sigma(stream, session.rows_of_run(name, 0), session.sources(0).streams[name])
    limit = SIGMAS * stated.latency + max(1 / stream.rate_hz, FRAME)
    # An image shows the middle of its exposure; the part of that is it over the root of 12.
    delays = [delay - np.sqrt(3) * stated.exposure for delay in delays]
    usual = float(np.median(delays))
    apart = np.abs(np.array(delays) - usual)
    single = apart / (limit + SCATTERS * 1.48 * float(np.median(apart)))
    doubt = [abs(usual) / limit, *(single if len(delays) >= 5 else [])]

    def text(worst: int) -> str:
        late = delays[worst - 1] if worst else usual
        which = f"in target {found[worst - 1] + 1}" if worst else f"in {len(delays)} presses"
        return (
            f"{which} it is {1e3 * late:+.0f} ms behind the arm's way into the skin, allowed "
            f"{1e3 * limit:.0f} ms: check the latency, and the clocks of both"
        )

    code = "force-time" if stream.traits.kind == "force" else "image-time"
    yield from most(doubt, code, f"streams/{name}", text)


def beyond_noise(moved: NDArray[np.floating]) -> Floats:
    """Return the size of a change (n,) less, in squares, that of the noise without contact."""
    noise = np.quantile(moved, 0.02)
    return np.sqrt(np.maximum(np.square(moved, dtype=np.float64) - noise**2, 0.0))


def force_timing(presses: Presses) -> Iterator[Testimony]:
    """Times of the gauge beside those of the arm."""
    force, axes = presses.force, presses.forces
    if force is not None and axes:
        level = -presses.values[:, 2] if 2 in axes else np.abs(presses.values[:, axes]).max(axis=1)
        yield from timing(presses, force, level)


def _delay(presses: Presses, one: Phase, times: NDArray[np.int64], level: Floats) -> float:
    """Return the delay of a signal behind the depth in one phase [s]; NaN if it cannot be told."""
    moments, places = presses.places(one.run)
    around = round(AROUND / NS)
    first, last = np.searchsorted(times, (one.start - around, one.end + around * (one.code == UP)))
    rows = np.arange(first, last, max(1, (last - first) // MOST))
    if len(rows) < FEWEST or len(moments) < 2:
        return float("nan")
    value = level[rows] - level[rows].mean()
    depth = 1e3 * (presses.height(one.target) - places[:, 2])
    at = (times[rows] - one.start) * NS - DELAYS[:, None]
    inside = np.maximum(np.interp(at, (moments - one.start) * NS, depth), 0.0)
    basis = np.stack([inside, inside**2], axis=-1)
    basis -= basis.mean(axis=1, keepdims=True)
    gram = basis.transpose(0, 2, 1) @ basis + 1e-9 * np.eye(2)
    fitted = (basis.transpose(0, 2, 1) @ value)[..., None]
    size = max(float(value @ value), 1e-12)
    explained = (fitted * np.linalg.solve(gram, fitted)).sum(axis=(1, 2)) / size
    explained[fitted[:, 0, 0] <= 0] = 0.0  # a signal rises with the depth
    best = int(explained.argmax())
    if not explained[best] > EXPLAINED or not 0 < best < len(DELAYS) - 1:
        return float("nan")
    low, middle, high = explained[best - 1 : best + 2]
    step = 0.5 * (DELAYS[1] - DELAYS[0])
    return float(DELAYS[best] + step * (low - high) / (low - 2 * middle + high))
