"""Packaged files: mock benches, a synthetic calibration and an example campaign.

A lab's own file has precedence. If a path does not exist, the packaged file of that name is used:
`benches/NAME`, `campaigns/NAME`, or the name alone.
"""

from pathlib import Path

_HOME = Path(__file__).parents[1] / "bench"
# Mock benches and the calibration of their gauge.
BENCHES = _HOME / "benches"
# Files among them that are no bench of one sensor: the settings of all, and a hand's.
OTHERS = ("mock", "pair")
# Example campaign of one day.
CAMPAIGNS = _HOME / "campaigns"


def packaged(path: Path, folder: Path) -> Path:
    """Return the path if it exists, else the packaged file of that name in a folder, if any."""
    if path.exists() or path.parent not in (Path(), Path(folder.name)):
        return path
    candidate = folder / path.name
    return candidate if candidate.is_file() else path
