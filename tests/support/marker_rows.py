"""Marker archives of given images, with the sources that `tactile markers` writes."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan


def write_rows(
    path: Path,
    session: str,
    t_ns: NDArray[np.int64],
    packed: NDArray[np.uint8],
    reference: NDArray[np.uint8],
) -> None:
    """Write an archive of one session's frames: packed masks (n, 38400) at times (n,) [ns]."""
    count = len(t_ns)
    plan = SensorPlan("mine", count, count, count, reference[None], 0.025)
    writer = ArchiveWriter.begin(path, ArchivePlan((plan,), ("sphere",), {}))
    number, length = np.zeros(count, np.int64), np.zeros(count)
    table = {
        **dict.fromkeys(("indenter", "target", "phase", "reference"), number),
        **dict.fromkeys(("seen", "valid"), np.ones(count, bool)),
        "location": number - 1,
        "depth": length,
        "position": np.zeros((count, 2)),
        "wrench": np.full((count, 6), np.nan),
        "frame": np.arange(count),
        "t_ns": t_ns,
    }
    source = [json.dumps({"session": session, "run": 0, "target": 0})] * count
    writer.sensors["mine"].write(0, packed=packed, table=table, source=source)
    writer.finish()
