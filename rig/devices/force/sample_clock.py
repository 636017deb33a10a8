"""When each sample of a device with a sample clock was taken, on the host's clock."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from rig.core.clock import SECOND_NS

_BUCKETS = 4
# Seconds of which the smallest delay counts: long enough to hold a quick answer even on a busy
# machine, short enough to follow a card whose clock drifts (100 ppm are 0.4 ms in 4 s).


class SampleTimeline:
    """Ties sample numbers to host time by the lower envelope of what was seen.

    The host asks now and then how many samples there are. Sample k cannot have been taken later
    than the host learnt of it, and the quickest answer is the closest: with period p, the smallest
    of (host time - k p) over the last seconds is where sample 0 lies. So samples of one block do
    not all carry the time at which the block was read, and a late read moves nothing.

    Args:
        rate_hz: Of the sample clock, as the device states it.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = SECOND_NS / rate_hz
        self._least: deque[tuple[int, int]] = deque(maxlen=_BUCKETS)
        self._last_ns = -1

    def observe(self, newest: int, now_ns: int) -> None:
        """Sample number `newest` existed at `now_ns`."""
        delay_ns = now_ns - round(newest * self._period_ns)
        second = now_ns // SECOND_NS
        if self._least and self._least[-1][0] == second:
            delay_ns = min(delay_ns, self._least.pop()[1])
        self._least.append((second, delay_ns))

    def time_ns(self, number: int) -> int:
        """When sample `number` was taken, as far as is known by now [ns].

        Raises:
            ValueError: Nothing was observed yet.
        """
        return min(delay_ns for _, delay_ns in self._least) + round(number * self._period_ns)

    def take(self, first: int, count: int) -> npt.NDArray[np.int64]:
        """Times (count,) [ns] of samples from `first` on, each after all that were taken before."""
        numbers = np.arange(count, dtype=np.int64)
        regular = self.time_ns(first) + np.rint(numbers * self._period_ns).astype(np.int64)
        # A quicker answer than ever moves the envelope back: never before what is out already.
        times: npt.NDArray[np.int64] = np.maximum(regular, self._last_ns + 1 + numbers)
        self._last_ns = int(times[-1])
        return times


# Status words of the F/T sensors whose wire has none: what is wrong with one sample.
#
# Where the Net F/T box has a bit for the same thing, the number is the same
# (rig/devices/force/netft_wire.py).

# A gauge is at the end of its output: the wrench is wrong.
SATURATED = 1 << 17
# An axis is beyond its rated range, before the tare: a warning; the bench's limits decide.
BEYOND_RATING = 1 << 16
# Samples between this one and the one before were lost.
LOST_BEFORE = 1 << 15
# The error byte of an RS-232 record: not 0 when the controller says its values are wrong.
RECORD_ERROR_MASK = 0xFF
