"""Files that come with the rig: its benches, a made-up calibration, a day of recordings.

A lab's own file comes first. Where a path names no file, the packaged one of that name is taken:
`benches/NAME`, `campaigns/NAME`, or the name alone.
"""

from __future__ import annotations

from pathlib import Path

_HOME = Path(__file__).parents[1] / "bench"
# Mock benches, and the calibration of their gauge.
BENCHES = _HOME / "benches"
# A day at the bench, as an example.
CAMPAIGNS = _HOME / "campaigns"


def packaged(path: Path, folder: Path) -> Path:
    """The path, or the packaged file that it stands for.

    Args:
        path: As somebody wrote it.
        folder: `BENCHES` or `CAMPAIGNS`.

    Returns:
        `path` itself where it exists, and where nothing stands for it.
    """
    if path.exists() or path.parent not in (Path(), Path(folder.name)):
        return path
    found = folder / path.name
    return found if found.is_file() else path
