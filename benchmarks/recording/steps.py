"""Steps of the benchmark, with their expected durations."""

from __future__ import annotations

from recorder.progress import Progress


class Steps:
    """Progress over all announced steps.

    Args:
        progress: Display of the fraction done; its name is that of the current step.
        total: Expected duration of all steps together [s].
    """

    def __init__(self, progress: Progress, total: float) -> None:
        self._progress, self._total = progress, total
        self._done = self._current = 0.0

    def step(self, title: str, seconds: float) -> None:
        """Begin a step that should take `seconds`; the previous step is done."""
        self._done += self._current
        self._current = seconds
        self._progress.name = title
        self._progress(min(self._done / self._total, 1.0))
