"""Sample times, from the lower envelope of the times at which the host received them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.clock import SECOND_NS
from rig.devices.force.nidaq import SampleTimeline

RATE = 1000.0
PERIOD = SECOND_NS // 1000


def polled(
    delays_ns: list[int], every: int = 10, start_ns: int = 5 * SECOND_NS, drift: float = 0.0
) -> np.ndarray:
    """Return the times of all samples; the host receives the end of each block `delays_ns` late."""
    timeline = SampleTimeline(RATE)
    times = []
    for k, delay_ns in enumerate(delays_ns, start=1):
        newest = k * every - 1
        taken_ns = start_ns + round(newest * PERIOD * (1 + drift))
        timeline.observe(newest, taken_ns + delay_ns)
        times.append(timeline.take(newest - every + 1, every))
    return np.concatenate(times)


def test_samples_of_one_block_lie_a_period_apart() -> None:
    times = polled([300_000] * 20)
    assert set(np.diff(times).tolist()) == {PERIOD}
    assert times[0] == 5 * SECOND_NS + 300_000


def test_one_late_answer_moves_nothing() -> None:
    delays = [200_000] * 50
    delays[20] = 80_000_000
    assert set(np.diff(polled(delays)).tolist()) == {PERIOD}


def test_the_quickest_answer_counts() -> None:
    times = polled([2_000_000, 100_000, 2_000_000, 2_000_000])
    ideal = 5 * SECOND_NS + np.arange(40) * PERIOD
    assert np.all(times[20:] - ideal[20:] == 100_000)


@given(delays=st.lists(st.integers(0, 50_000_000), min_size=1, max_size=60))
def test_times_strictly_increase_and_never_lie_ahead_of_the_answer(delays: list[int]) -> None:
    times = polled(delays)
    assert all(a < b for a, b in itertools.pairwise(times.tolist()))
    newest = 5 * SECOND_NS + (np.arange(1, len(delays) + 1) * 10 - 1) * PERIOD + np.array(delays)
    # Ahead only where a quicker answer came later, by a nanosecond each.
    assert np.all(times[9::10] <= np.maximum.accumulate(newest) + 600)


@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
def test_a_card_whose_clock_drifts_is_followed(drift: float) -> None:
    times = polled([100_000] * 3000, drift=drift)
    taken = 5 * SECOND_NS + np.round(np.arange(30_000) * PERIOD * (1 + drift))
    # 100 ppm over the seconds for which the smallest delay is valid.
    assert np.abs(times - taken - 100_000).max() < 500_000
