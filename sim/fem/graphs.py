# mypy: ignore-errors
# Warp's graphs are typed at run time; mypy cannot follow them.
"""Launches that are repeated with the same arrays, recorded as graphs.

To launch a kernel costs Python 50 us or more, a graph of many of them about as much as one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable

import warp as wp


class Graphs:
    """Graphs of one device, by keys of all that their launches depend on.

    Args:
        device: Device of the launches.
        record: Record them; else they are launched one by one.
    """

    def __init__(self, device, *, record: bool = True) -> None:
        self._device, self._records = device, record
        self._graphs = {}

    def run(self, key: Hashable, work: Callable[[], None]) -> None:
        """Do `work`, which only launches kernels; it is recorded the second time.

        The first time compiles kernels, which a recording must not.
        """
        if not self._records:
            work()
            return
        if key not in self._graphs:
            self._graphs[key] = None
            work()
            return
        if self._graphs[key] is None:
            with wp.ScopedCapture(self._device) as capture:
                work()
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])
