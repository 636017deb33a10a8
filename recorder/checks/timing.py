"""Witness of presses: when and how far a gauge or a sensor shows them, beside the arm's way."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from recorder.checks.testimony import Testimony, worst
from recorder.findings import Finding
from recorder.session.columns import Stream
from recorder.session.delays import DELAYS, Level, force_level, press_delays, timed_phases
from recorder.session.presses import Presses
from recorder.session.uncertainty import latency_sigma, since_shown

# Standard deviations of the latency that a delay may have, besides one frame, and the least of that
# [s]; standard errors of the delay itself. Time that a press may be beside others [s], and periods:
# twice that, with some scatters, is too much. How much more the arm's way leaves of its signal,
# over the spread of others; factor to those of its depth and point; part that another may have.
SIGMAS, FRAME, ERRORS, APART, FRAMES, SCATTERS = 3.0, 1 / 30, 3.0, 0.06, 1.5, 4.0
UNLIKE, BESIDE, PLACE = 0.3, 3.6, 0.4
# Least number of presses that tell if a force follows the depth, its spread over a felt force, and
# what the depth leaves of it in the median.
SEVERAL, SPREAD, LEAVES = 5, 0.4, 0.8


def timing(presses: Presses, stream: Stream, level: Level) -> Iterator[Testimony]:
    """Yield the testimonies about the presses in a stream, whose signal has a level."""
    found = press_delays(presses, stream, level, timed_phases(presses))
    told = np.array([one.delay for one in found if np.isfinite(one.delay)])
    kind, where = stream.traits.kind, f"streams/{stream.name}"
    sigma, longest = latency_sigma(stream)
    limit = SIGMAS * sigma + max(1 / stream.rate_hz, FRAME)
    felt = [one for one in found if one.spread.max() > SPREAD * presses.felt(2)]
    if kind == "force" and len(felt) >= SEVERAL:
        near = np.abs(DELAYS) <= limit
        part = float(np.median([one.left[near].min() / one.spread.max() for one in felt]))
        message = (
            f"{part:.0%} of it is not by the depth in the median of {len(felt)} presses: check"
        )
        finding = Finding("depth-force", where, f"{message} axes, times, and that the tip touches")
        yield Testimony(part / LEAVES, finding)
    if len(told) < 2:
        return
    usual = float(np.median(told))
    late = float(since_shown(stream, [usual])[0]) - 0.5 * (longest or 0.0)
    scatter = 1.48 * float(np.median(np.abs(told - usual)))
    limit += ERRORS * scatter / len(told) ** 0.5
    beside = max(APART, FRAMES / stream.rate_hz)
    near, spreads = np.abs(DELAYS - usual) < beside, np.array([one.spread for one in found])
    spread = float(np.median(spreads.max(axis=1)))
    text = (
        f"in {len(told)} presses it is {1e3 * late:+.0f} ms behind the arm's way into the skin, "
        f"allowed {1e3 * limit:.0f} ms: check the latency, and the clocks of both"
    )
    some = [(abs(late) / limit, text)]
    left = np.array([one.left[near].min() for one in found]) / spread
    apart = [abs(one.delay - usual) / (2 * beside + SCATTERS * scatter) for one in found]
    doubt = np.fmax((left - np.median(left)) / UNLIKE, apart).tolist()
    for one, part, each in zip(found, left.tolist(), doubt, strict=True):
        text = f"in target {one.target + 1}, {part:.0%} of it is not by the arm's way into the skin"
        some.append((each, f"{text} at the others' delay: check the times of both"))
    yield from worst(some, "force-time" if kind == "force" else "image-time", where)
    by, some = ("depth",) if kind == "force" else ("depth", "point"), []
    plans = np.array([[presses.planned(name, one.target) for name in by] for one in found])
    for one, plan in zip(found, plans, strict=True):
        alike = spreads[(np.abs(plans - plan) < 1e-6).all(axis=1)]
        few = len(alike) < 3
        others = np.median(spreads[plans[:, 0] <= plan[0]] if few else alike, axis=0)
        ratio = np.maximum(one.spread / np.maximum(others, 1e-9), 1e-9)
        factor = max(1.0, PLACE / ratio.min()) if few else max(1 / ratio.min(), ratio.max())
        text = f"target {one.target + 1} has {factor:.3g} times more, or less, of the signal than"
        some.append((factor / BESIDE, f"{text} others of its depth"))
    yield from worst(some, "scale", where)


def force_timing(presses: Presses) -> Iterator[Testimony]:
    """Times and sizes of the gauge's presses beside the arm's way."""
    if presses.force is not None and presses.forces:
        yield from timing(presses, presses.force, force_level(presses))
