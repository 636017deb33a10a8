"""Marker archives: binary images, references and labels of many sensors, for training.

The format is specified in `docs/reference/data-format.md`; this package is its only implementation.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from recorder.archive.check import check_archive as check_archive
    from recorder.archive.check import marker_flags as marker_flags
    from recorder.archive.format import COLUMNS as COLUMNS
    from recorder.archive.format import GIVEN as GIVEN
    from recorder.archive.format import MASKS as MASKS
    from recorder.archive.format import NO_PHASE as NO_PHASE
    from recorder.archive.format import SHADING as SHADING
    from recorder.archive.format import SHADING_SIDE as SHADING_SIDE
    from recorder.archive.format import SHADING_ZERO as SHADING_ZERO
    from recorder.archive.format import ArchivePlan as ArchivePlan
    from recorder.archive.format import MarkerCount as MarkerCount
    from recorder.archive.format import SensorPlan as SensorPlan
    from recorder.archive.pairs import location_pairs as location_pairs
    from recorder.archive.pairs import press_rows as press_rows
    from recorder.archive.reader import ArchivedSensor as ArchivedSensor
    from recorder.archive.reader import MarkerArchive as MarkerArchive
    from recorder.archive.reader import Rows as Rows
    from recorder.archive.reader import Simulated as Simulated
    from recorder.archive.reader import archive_fingerprint as archive_fingerprint
    from recorder.archive.writer import CHUNK_ROWS as CHUNK_ROWS
    from recorder.archive.writer import UNIT_ROWS as UNIT_ROWS
    from recorder.archive.writer import ArchiveWriter as ArchiveWriter
    from recorder.archive.writer import Frames as Frames
    from recorder.archive.writer import SensorFrames as SensorFrames
    from recorder.archive.writer import fill_archive as fill_archive
    from recorder.archive.writer import write_simulated as write_simulated

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
