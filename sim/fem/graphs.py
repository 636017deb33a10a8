# mypy: ignore-errors
# Warp's graphs are typed at run time; mypy cannot follow them.
"""Launches that are repeated with the same arrays, recorded as graphs.

To launch a kernel costs Python 50 us or more, a graph of many of them about as much as one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Hashable, Iterator

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

    def launched(self, key: Hashable) -> bool:
        """Launch the graph of `key`, if it is recorded; else do its launches inside `recorded`."""
        graph = self._graphs.get(key)
        if graph is None:
            return False
        wp.capture_launch(graph)
        return True

    @contextlib.contextmanager
    def recorded(self, key: Hashable) -> Iterator[None]:
        """Context of launches of kernels, and of nothing else; they are recorded the second time.

        The first time compiles kernels, which a recording must not.
        """
        if not self._records or key not in self._graphs:
            yield
            if self._records:
                self._graphs[key] = None
            return
        with wp.ScopedCapture(self._device) as capture:
            yield
        self._graphs[key] = capture.graph
        wp.capture_launch(capture.graph)
