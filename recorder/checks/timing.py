"""Witness of times: when a gauge or a sensor shows a press, beside the arm's way into the skin."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from recorder.checks.testimony import Testimony, most
from recorder.session.columns import Stream
from recorder.session.delays import Level, force_level, press_delays, timed_phases
from recorder.session.presses import Presses
from recorder.session.uncertainty import latency_sigma, since_shown

# Standard deviations of the latency that a delay may have, besides one frame, and the least of that
# [s]; and that of a single press, over this, and over the scatter of the session's.
SIGMAS, FRAME, SINGLE, SCATTERS = 3.0, 1 / 30, 2.0, 4.0


def timing(presses: Presses, stream: Stream, level: Level) -> Iterator[Testimony]:
    """Yield the testimony about the times of a stream, whose signal has a level."""
    found = press_delays(presses, stream, level, timed_phases(presses))
    if len(found) < 2:
        return
    sigma, longest = latency_sigma(stream)
    limit = SIGMAS * sigma + max(1 / stream.rate_hz, FRAME)
    delays = since_shown(stream, [one.delay for one in found]) - 0.5 * (longest or 0.0)
    usual = float(np.median(delays))
    apart = np.abs(delays - usual)
    single = apart / (SINGLE * limit + SCATTERS * 1.48 * float(np.median(apart)))
    doubt = [abs(usual) / limit, *(single if len(delays) >= 5 else [])]

    def text(worst: int) -> str:
        late = delays[worst - 1] if worst else usual
        which = f"in target {found[worst - 1].target + 1}" if worst else f"in {len(delays)} presses"
        return (
            f"{which} it is {1e3 * late:+.0f} ms behind the arm's way into the skin, allowed "
            f"{1e3 * limit:.0f} ms: check the latency, and the clocks of both"
        )

    code = "force-time" if stream.traits.kind == "force" else "image-time"
    yield from most(doubt, code, f"streams/{stream.name}", text)


def force_timing(presses: Presses) -> Iterator[Testimony]:
    """Times of the gauge beside those of the arm."""
    if presses.force is not None and presses.forces:
        yield from timing(presses, presses.force, force_level(presses))
