"""Witness of times: when a gauge or a sensor shows a press, beside the arm's way into the skin.

Forces and pictures follow the indentation. In each press, the delay is found at which a signal is
best described by the depth and its square, on the way down and up: what depends on the direction,
such as a surface that is lower than stated, has opposite effects on the two, whose mean is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from recorder.checks.presses import DEEP, DOWN, UP, Phase, Presses
from recorder.checks.testimony import Testimony, most
from recorder.session.align import NS, captured
from recorder.session.columns import Stream, StreamPart
from recorder.session.uncertainty import latency_sigma, longest_exposure

Floats = NDArray[np.float64]
Level = Callable[[int, int], Floats]

# Delays that are tried [s]; time around a phase that is looked at [s]; most samples of a phase, and
# fewest; and how much of a signal the depth must explain.
DELAYS, AROUND, MOST, FEWEST, EXPLAINED = np.arange(-0.4, 0.401, 0.01), 0.1, 60, 6, 0.98
# Standard deviations of the latency that a delay may have, besides one frame, and the least of that
# [s]; and that of a single press, over this, and over the scatter of the session's.
SIGMAS, FRAME, SINGLE, SCATTERS = 3.0, 1 / 30, 2.0, 4.0


def timing(presses: Presses, stream: Stream, level: Level) -> Iterator[Testimony]:
    """Yield the testimony about the times of a stream.

    `level` returns the signal (n,) of rows [first, last): 0 without contact, and larger the deeper
    the tip is. Presses in which it is NaN are left out.
    """
    name = stream.name
    delays: list[float] = []
    found: list[int] = []
    by_press: dict[tuple[int, int], dict[int, float]] = {}
    for one in presses.phases:
        if one.whole and one.code in (DOWN, UP) and presses.planned("depth", one.target) >= DEEP:
            delay = _delay(presses, one, stream, level)
            by_press.setdefault((one.run, one.target), {})[one.code] = delay
    for (_run, target), of_press in by_press.items():
        both = [of_press.get(code, np.nan) for code in (DOWN, UP)]
        if np.isfinite(both).all():
            delays.append(float(np.mean(both)))
            found.append(target)
    if len(delays) < 2:
        return
    sigma, longest = latency_sigma(stream)
    limit = SIGMAS * sigma + max(1 / stream.rate_hz, FRAME)
    delays = [delay - 0.5 * (longest or 0.0) for delay in delays]
    if stream.traits.kind == "camera":  # an image shows the middle of its exposure
        delays = [delay - 0.5 * longest_exposure(stream) for delay in delays]
    usual = float(np.median(delays))
    apart = np.abs(np.array(delays) - usual)
    single = apart / (SINGLE * limit + SCATTERS * 1.48 * float(np.median(apart)))
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


def beyond_noise(moved: NDArray[np.floating]) -> Level:
    """Return the level by a change (n,), which is less, in squares, that of the noise at rest."""
    noise = np.quantile(moved, 0.02)
    size = np.sqrt(np.maximum(np.square(moved, dtype=np.float64) - noise**2, 0.0))
    return lambda first, last: size[first:last]


def force_timing(presses: Presses) -> Iterator[Testimony]:
    """Times of the gauge beside those of the arm."""
    force, axes = presses.force, presses.forces
    if force is not None and axes:

        def level(first: int, last: int) -> Floats:
            values = presses.values(first, last)
            return -values[:, 2] if 2 in axes else np.abs(values[:, axes]).max(axis=1)

        yield from timing(presses, force, level)


def _delay(presses: Presses, one: Phase, stream: Stream, level: Level) -> float:
    """Return the delay of a signal behind the depth in one phase [s]; NaN if it cannot be told."""
    moments, places = presses.places(one.run)
    of_run, around = presses.session.rows_of_run(stream.name, one.run), round(AROUND / NS)
    ends = (one.start - around, one.end + around * (one.code == UP))
    first, last = (of_run.start or 0) + np.searchsorted(stream.t_ns[of_run], ends)
    if last - first < FEWEST or len(moments) < 2:
        return float("nan")
    some = slice(None, None, max(1, (last - first) // MOST))
    times, value = captured(StreamPart(stream, first, last))[some], level(first, last)[some]
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
    if not explained[best] > EXPLAINED or not 0 < best < len(DELAYS) - 1:
        return float("nan")
    low, middle, high = explained[best - 1 : best + 2]
    step = 0.5 * (DELAYS[1] - DELAYS[0])
    return float(DELAYS[best] + step * (low - high) / (low - 2 * middle + high))
