"""Witness of presses: when and how far a gauge or a sensor shows them, beside the arm's way."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from recorder.checks.testimony import Testimony, most
from recorder.session.columns import Stream
from recorder.session.delays import DELAYS, Level, force_level, press_delays, timed_phases
from recorder.session.presses import Presses
from recorder.session.uncertainty import latency_sigma, since_shown

# Standard deviations of the latency that a delay may have, besides one frame, and the least of that
# [s]. Time that a single press may be beside others [s], and what the arm's way then leaves of its
# signal, over the spread of others. Factor to others of its depth and point; and part of a signal
# that there may be at another point.
SIGMAS, FRAME, APART, UNLIKE, BESIDE, PLACE = 3.0, 1 / 30, 0.06, 0.4, 3.0, 0.4


def timing(presses: Presses, stream: Stream, level: Level) -> Iterator[Testimony]:
    """Yield the testimonies about the presses in a stream, whose signal has a level."""
    found = press_delays(presses, stream, level, timed_phases(presses))
    told = [one for one in found if np.isfinite(one.delay)]
    if len(told) < 2:
        return
    sigma, longest = latency_sigma(stream)
    limit = SIGMAS * sigma + max(1 / stream.rate_hz, FRAME)
    usual = float(np.median([one.delay for one in told]))
    late = float(since_shown(stream, [usual])[0]) - 0.5 * (longest or 0.0)
    near, spreads = np.abs(DELAYS - usual) < APART, np.array([one.spread for one in found])
    spread = float(np.median([one.spread.max() for one in told]))
    left = [float(one.left[near].min()) / spread for one in found]

    def text(worst: int) -> str:
        if worst:
            which = f"in target {found[worst - 1].target + 1}, {left[worst - 1]:.0%} of it does"
            return f"{which} not follow the arm's way into the skin: check the times of both"
        return (
            f"in {len(told)} presses it is {1e3 * late:+.0f} ms behind the arm's way into the skin,"
            f" allowed {1e3 * limit:.0f} ms: check the latency, and the clocks of both"
        )

    kind, where = stream.traits.kind, f"streams/{stream.name}"
    code = "force-time" if kind == "force" else "image-time"
    yield from most([abs(late) / limit, *np.array(left) / UNLIKE], code, where, text)
    by = ("depth",) if kind == "force" else ("depth", "point")
    plans = np.array([[presses.planned(name, one.target) for name in by] for one in found])
    worst = []
    for plan, own in zip(plans, spreads, strict=True):
        alike = spreads[(np.abs(plans - plan) < 1e-6).all(axis=1)]
        few = len(alike) < 3
        usual = np.median(spreads[plans[:, 0] <= plan[0]] if few else alike, axis=0)
        ratio = np.maximum(own / np.maximum(usual, 1e-9), 1e-9)
        worst.append(min(ratio.min() / PLACE, 1.0) if few else min(ratio.min(), 1 / ratio.max()))
    yield from most(
        1 / (BESIDE * np.array(worst)),
        "scale",
        where,
        lambda k: (
            f"target {found[k].target + 1} has {1 / worst[k]:.3g} times more, or less, of the "
            "signal than others of its depth"
        ),
    )


def force_timing(presses: Presses) -> Iterator[Testimony]:
    """Times of the gauge beside those of the arm."""
    if presses.force is not None and presses.forces:
        yield from timing(presses, presses.force, force_level(presses))
