"""Marker archives: binary images, references and labels of many sensors, for training.

The format is specified in `docs/reference/data-format.md`; this package is its only implementation.
"""

from recorder.archive.arrays import (
    COLUMNS,
    GIVEN,
    MASKS,
    NO_PHASE,
    REPRESENTATIONS,
    SHADING,
    SHADING_SIDE,
    SHADING_ZERO,
    Representation,
)
from recorder.archive.check import check_archive, marker_flags
from recorder.archive.pairs import PRESETS, LocationPairs, location_pairs, press_rows
from recorder.archive.plan import FORMAT_VERSION, ArchivePlan, MarkerCount, SensorPlan
from recorder.archive.reader import ArchivedSensor, MarkerArchive, Rows, Simulated, describe_archive
from recorder.archive.writer import ArchiveWriter, SensorWriter, write_simulated

__all__ = [
    "COLUMNS",
    "FORMAT_VERSION",
    "GIVEN",
    "MASKS",
    "NO_PHASE",
    "PRESETS",
    "REPRESENTATIONS",
    "SHADING",
    "SHADING_SIDE",
    "SHADING_ZERO",
    "ArchivePlan",
    "ArchiveWriter",
    "ArchivedSensor",
    "LocationPairs",
    "MarkerArchive",
    "MarkerCount",
    "Representation",
    "Rows",
    "SensorPlan",
    "SensorWriter",
    "Simulated",
    "check_archive",
    "describe_archive",
    "location_pairs",
    "marker_flags",
    "press_rows",
    "write_simulated",
]
