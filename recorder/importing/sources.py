"""What to import, and what of it is known."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recorder.errors import SessionError

_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class ImportOrder:
    """Files of one recording, which start together, and what they do not say themselves."""

    out: Path
    """The session to write."""
    sensor: str
    """Name of the sensor."""
    indenter: str
    """Name of what touched it."""
    video: Path | None = None
    """Video file, or folder of images."""
    force: Path | None = None
    """Forces: .csv or .npy."""
    taxels: Path | None = None
    """Taxel counts: .npy."""
    fps: float | None = None
    """Images per second; None: what the video says."""
    force_hz: float | None = None
    """Force rows per second; None: by the time column."""
    taxels_hz: float | None = None
    """Taxel rows per second."""
    units: str | None = None
    """Unit of forces that do not say theirs."""
    torque_units: str | None = None
    """The same for torques."""
    ignore: tuple[str, ...] = ()
    """Force columns to leave out."""
    trim: bool = False
    """Cut all to the shortest, rather than refuse recordings of unequal length."""
    operator: str = ""
    """Who recorded it."""

    def __post_init__(self) -> None:
        """Refuse an order for nothing, and impossible rates.

        Raises:
            SessionError: Names the option.
        """
        if self.video is None and self.force is None and self.taxels is None:
            raise SessionError("found nothing to import; say --video, --force or --taxels")
        for name in ("fps", "force_hz", "taxels_hz"):
            rate = getattr(self, name)
            option = "--" + name.replace("_", "-")
            if rate is not None and not 0 < rate <= 100_000:
                raise SessionError(f"{option}: found {rate:g}; allowed: above 0 to 100000")
            needed = {"fps": self.video, "force_hz": self.force, "taxels_hz": self.taxels}[name]
            if rate is not None and needed is None:
                raise SessionError(f"{option}: found {rate:g} without the file it is the rate of")

    def files(self) -> dict[str, dict[str, Any]]:
        """Name, size and SHA-256 of each file; of a folder, over its files in order of the names.

        Raises:
            OSError: One cannot be read.
        """
        found = {}
        for name in ("video", "force", "taxels"):
            path: Path | None = getattr(self, name)
            if path is not None:
                found[name] = {"name": path.name, "sha256": _sha256(path)}
        return found


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    files = sorted(e for e in path.iterdir() if e.is_file()) if path.is_dir() else [path]
    for file in files:
        if path.is_dir():
            digest.update(f"{file.name} {file.stat().st_size}\n".encode())
        with file.open("rb") as content:
            while block := content.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()
