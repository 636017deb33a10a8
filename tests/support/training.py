"""Surroundings of a training for tests, with a stop after some steps."""

from typing import Any

from learning.training.run import RunFolder, Stop, TrainingSession, accelerator


class StopAfter(Stop):
    """Asks for a stop at the given number of looks, as Ctrl-C does; 0: never."""

    def __init__(self, looks: int = 0) -> None:
        super().__init__()
        self._left = looks

    def agreed(self, launched: object) -> bool:
        self._left -= 1
        self.requested = self.requested or self._left == 0
        return self.requested


def session(settings: Any, run: RunFolder | None = None, stop_after: int = 0) -> TrainingSession:
    """Return a session on the device of the settings, in a folder or in memory."""
    return TrainingSession(
        accelerator(settings.launch), run or RunFolder.nowhere(), StopAfter(stop_after)
    )
