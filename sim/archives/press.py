"""A press that is simulated once, and which of its frames become rows of an archive."""

from __future__ import annotations

from dataclasses import dataclass

from sim.motion import Motion

NO_PHASE = -1
NO_LOCATION = -1


@dataclass(frozen=True, slots=True)
class Recording:
    """Frames of one target: rows of an archive that are compressed together."""

    target: int
    """Its number within the indenter, as in the whole plan."""
    number: int
    """Its number among all that a sensor could ever have: what is drawn for a frame follows it."""
    session_point: int
    """Number of its contact point in the sensor's life, 0 where nothing creeps."""
    frames: tuple[int, ...]
    """Frames of the press's motion."""
    phases: tuple[int, ...]
    """Code of the phase of each, or -1."""
    locations: tuple[int, ...]
    """Location of each, or -1."""

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.frames)


@dataclass(frozen=True, slots=True)
class Press:
    """One indenter on one motion, as the robot was told."""

    indenter: str
    motion: Motion
    recordings: tuple[Recording, ...]
    """All of equal length."""
