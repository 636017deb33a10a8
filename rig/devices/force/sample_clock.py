"""Times of samples on the host's clock, for a device with a sample clock."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from rig.core.clock import SECOND_NS

# Number of seconds over which the smallest delay counts: long enough to contain a quick answer even
# on a busy machine, short enough to follow a card whose clock drifts (100 ppm are 0.4 ms in 4 s).
_BUCKETS = 4


class SampleTimeline:
    """Maps sample numbers to host time by the lower envelope of the observations.

    The host regularly reads the number of samples. Sample k cannot have been taken after the host
    learnt of it, and the quickest answer is the closest: with period p, sample 0 is at the smallest
    (host time - k p) of the last seconds. So the samples of one block do not all have the time at
    which the block was read, and a late read changes nothing.

    Args:
        rate_hz: Rate of the sample clock, as the device states it.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = SECOND_NS / rate_hz
        self._least: deque[tuple[int, int]] = deque(maxlen=_BUCKETS)
        self._last_ns = -1

    def observe(self, newest: int, now_ns: int) -> None:
        """Record that sample number `newest` existed at `now_ns`."""
        delay_ns = now_ns - round(newest * self._period_ns)
        second = now_ns // SECOND_NS
        if self._least and self._least[-1][0] == second:
            delay_ns = min(delay_ns, self._least.pop()[1])
        self._least.append((second, delay_ns))

    def time_ns(self, number: int) -> int:
        """Return the best current estimate of the time of sample `number` [ns]."""
        return min(delay_ns for _, delay_ns in self._least) + round(number * self._period_ns)

    def take(self, first: int, count: int) -> npt.NDArray[np.int64]:
        """Return times (count,) [ns] of samples from `first` on, later than all returned before."""
        numbers = np.arange(count, dtype=np.int64)
        regular = self.time_ns(first) + np.rint(numbers * self._period_ns).astype(np.int64)
        # A new quickest answer moves the envelope back, but not before times already returned.
        times: npt.NDArray[np.int64] = np.maximum(regular, self._last_ns + 1 + numbers)
        self._last_ns = int(times[-1])
        return times


# Status words of F/T sensors that transmit none: the problems of one sample.
#
# Where the Net F/T box has a bit for the same problem, the number is the same
# (rig/devices/force/netft_wire.py).

# A gauge is at the limit of its output: the wrench is wrong.
SATURATED = 1 << 17
# An axis is beyond its rated range, before the tare: a warning; the bench's limits decide.
BEYOND_RATING = 1 << 16
# Samples between this one and the previous one were lost.
LOST_BEFORE = 1 << 15
