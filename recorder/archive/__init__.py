"""Marker archives: binary images, references and labels of many sensors, for training.

The format is specified in `docs/reference/data-format.md`; this package is its only implementation.
"""

from recorder.archive.check import check_archive, marker_flags
from recorder.archive.format import (
    COLUMNS,
    GIVEN,
    MASKS,
    NO_PHASE,
    SHADING,
    SHADING_SIDE,
    SHADING_ZERO,
    ArchivePlan,
    MarkerCount,
    SensorPlan,
)
from recorder.archive.pairs import location_pairs, press_rows
from recorder.archive.reader import (
    ArchivedSensor,
    MarkerArchive,
    Rows,
    Simulated,
    archive_fingerprint,
)
from recorder.archive.writer import (
    CHUNK_ROWS,
    UNIT_ROWS,
    ArchiveWriter,
    Frames,
    SensorFrames,
    fill_archive,
    write_simulated,
)

__all__ = [
    "CHUNK_ROWS",
    "COLUMNS",
    "GIVEN",
    "MASKS",
    "NO_PHASE",
    "SHADING",
    "SHADING_SIDE",
    "SHADING_ZERO",
    "UNIT_ROWS",
    "ArchivePlan",
    "ArchiveWriter",
    "ArchivedSensor",
    "Frames",
    "MarkerArchive",
    "MarkerCount",
    "Rows",
    "SensorFrames",
    "SensorPlan",
    "Simulated",
    "archive_fingerprint",
    "check_archive",
    "fill_archive",
    "location_pairs",
    "marker_flags",
    "press_rows",
    "write_simulated",
]
