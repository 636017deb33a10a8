"""Pacing is exact in whole nanoseconds, never bursts, and counts missed ticks."""

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.fake_clock import FakeClock
from rig.core.clock import SECOND_NS, ClockAnchor, Pacer, SystemClock

rates = st.floats(1, 1000)
delays = st.lists(st.floats(0, 0.2), max_size=60)


@given(rates, delays, st.integers(0, 2**60))
def test_ticks_come_in_order_and_every_tick_is_met_or_counted(
    rate_hz: float, work: list[float], origin: int
) -> None:
    clock = FakeClock(origin)
    pacer = Pacer(clock, rate_hz)
    deadlines = []
    for seconds in work:
        clock.advance(seconds)
        deadlines.append(pacer.wait())
    assert deadlines == sorted(set(deadlines))
    if deadlines:
        ticks = round((deadlines[-1] - origin) * rate_hz / SECOND_NS)
        assert ticks == len(deadlines) + pacer.missed


@given(rates, st.integers(1, 1_000_000))
def test_deadlines_do_not_drift(rate_hz: float, tick: int) -> None:
    pacer = Pacer(FakeClock(), rate_hz)
    assert abs(pacer.deadline_ns(tick) - tick * SECOND_NS / rate_hz) <= 1


@given(rates)
def test_a_long_pause_is_no_reason_for_a_burst(rate_hz: float) -> None:
    clock = FakeClock()
    pacer = Pacer(clock, rate_hz)
    pacer.wait()
    clock.advance(3.0)
    period_ns = SECOND_NS / rate_hz
    late = pacer.wait()
    assert pacer.wait() - late == pytest.approx(period_ns, abs=2)


def test_the_last_ticks_that_a_driver_keeps_follow_each_other_after_a_pause() -> None:
    clock = FakeClock()
    pacer = Pacer(clock, 10.0, behind=2)
    clock.advance(0.75)
    assert [pacer.wait() * 10 // SECOND_NS for _ in range(4)] == [5, 6, 7, 8]
    assert pacer.missed == 4


def test_a_rate_of_nothing_is_refused() -> None:
    for rate_hz in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="rate_hz"):
            Pacer(FakeClock(), rate_hz)


def test_the_system_clock_is_the_monotonic_one_and_sleeps_no_shorter_than_asked() -> None:
    clock = SystemClock()
    before = time.monotonic_ns()
    deadline = clock.now_ns() + 2_000_000
    clock.sleep_until(deadline)
    assert clock.now_ns() >= deadline
    assert before <= deadline - 2_000_000 <= time.monotonic_ns()


def test_an_anchor_ties_both_clocks_of_one_boot() -> None:
    first, second = ClockAnchor.take(), ClockAnchor.take()
    assert first.boot_id == second.boot_id
    assert second.t0_ns > first.t0_ns
    drift = (second.utc_ns - first.utc_ns) - (second.t0_ns - first.t0_ns)
    assert abs(drift) < SECOND_NS
