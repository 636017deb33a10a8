"""What can go wrong: a scene that means nothing, and a solution that was not found."""

from __future__ import annotations

from pathlib import Path


class SceneError(ValueError):
    """A scene is not physical or not solvable: the message names field, value, what is allowed."""


class SimulationDiverged(RuntimeError):
    """No converged state was found, even with the smallest step; nothing unconverged is returned.

    `tried` lists the attempts (step, iterations, residual); `dump` is the `.npz` with the last
    converged state and the scene, or None where it could not be written.
    """

    def __init__(self, message: str, tried: tuple[str, ...] = (), dump: Path | None = None) -> None:
        super().__init__(message)
        self.tried = tried
        self.dump = dump
