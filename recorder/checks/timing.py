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
# signal, over the spread of others. Factor to other presses of its depth, and of its point.
SIGMAS, FRAME, APART, UNLIKE, BESIDE = 3.0, 1 / 30, 0.06, 0.4, 3.0


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
    near, spread = np.abs(DELAYS - usual) < APART, float(np.median([one.spread for one in told]))
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
    plans = [
        (
            presses.planned("depth", one.target),
            kind == "force" or presses.planned("point", one.target),
        )
        for one in found
    ]
    factors = []
    for one, plan in zip(found, plans, strict=True):
        alike = [other.spread for other, of in zip(found, plans, strict=True) if of == plan]
        usual = float(np.median(alike)) if len(alike) > 2 else one.spread
        factors.append(max(one.spread, 1e-9) / max(usual, 1e-9))
    yield from most(
        [max(one, 1 / one) / BESIDE for one in factors],
        "scale",
        where,
        lambda k: (
            f"target {found[k].target + 1} has {factors[k]:.3g} times the signal of others "
            "of its depth"
        ),
    )


def force_timing(presses: Presses) -> Iterator[Testimony]:
    """Times of the gauge beside those of the arm."""
    if presses.force is not None and presses.forces:
        yield from timing(presses, presses.force, force_level(presses))
