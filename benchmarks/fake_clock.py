"""Clock for benchmarks and tests of `rig` that need no real time."""

from rig.core.clock import SECOND_NS


class FakeClock:
    """Clock that moves only when it is advanced or slept on."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """Return the time it was last moved to [ns]."""
        return self._now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """Move to `deadline_ns` if it lies ahead."""
        self._now_ns = max(self._now_ns, deadline_ns)

    def advance(self, seconds: float) -> None:
        """Move forward by `seconds` [s]."""
        self._now_ns += round(seconds * SECOND_NS)
