"""Real recordings that the emulators of a mock bench play in place of its World."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Sources:
    """Recordings to play; None: the World's data instead."""

    camera: Path | None = None
    """A folder of images or a video file."""
    camera_motion: str = "moving"
    """`moving`: one source frame per camera frame; `still`: each image held for seconds."""
    taxels: Path | None = None
    """A .npy file of raw counts (T, 48)."""

    def __post_init__(self) -> None:
        """Reject a missing path before anything is started."""
        for name, path in (("--camera", self.camera), ("--taxels", self.taxels)):
            if path is not None and not path.exists():
                raise ConfigError(f"{name}: {path}: no such file or folder")

    def description(self) -> dict[str, Any]:
        """Return the entries for the session's metadata: file names without local paths."""
        description: dict[str, Any] = {}
        if self.camera is not None:
            description["camera"] = {"name": self.camera.name, "motion": self.camera_motion}
        if self.taxels is not None:
            description["taxels"] = {"name": self.taxels.name}
        return description
