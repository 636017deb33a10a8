"""Dataset store: record, read, align, check and export sessions; read marker archives.

The format is specified in `docs/reference/data-format.md`; this package is its only implementation.
A public name is imported when it is first used: progress and settings need neither Zarr nor NumPy.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from recorder.archive import MarkerArchive as MarkerArchive
    from recorder.checks.check import check as check
    from recorder.checks.plausible import doubts as doubts
    from recorder.checks.recover import recover as recover
    from recorder.errors import SessionError as SessionError
    from recorder.findings import Finding as Finding
    from recorder.findings import faults as faults
    from recorder.session.align import Window as Window
    from recorder.session.columns import Stream as Stream
    from recorder.session.reader import Session as Session
    from recorder.session.sheet import contact_sheet as contact_sheet
    from recorder.session.stream_writer import StreamWriter as StreamWriter
    from recorder.session.tables import to_pandas as to_pandas
    from recorder.session.tables import to_xarray as to_xarray
    from recorder.session.writer import SessionWriter as SessionWriter
    from recorder.spec import FORMAT_VERSION as FORMAT_VERSION
    from recorder.spec import OUTCOMES as OUTCOMES
    from recorder.spec import PHASES as PHASES
    from recorder.spec import REFERENCE as REFERENCE
    from recorder.spec import SEGMENTS as SEGMENTS
    from recorder.spec import Column as Column
    from recorder.spec import StreamSpec as StreamSpec
    from recorder.spec import Traits as Traits
    from recorder.spec import arm_wrench_spec as arm_wrench_spec
    from recorder.spec import camera_spec as camera_spec
    from recorder.spec import depth_spec as depth_spec
    from recorder.spec import event_row as event_row
    from recorder.spec import event_text as event_text
    from recorder.spec import events_spec as events_spec
    from recorder.spec import force_spec as force_spec
    from recorder.spec import joints_spec as joints_spec
    from recorder.spec import pose_spec as pose_spec
    from recorder.spec import taxels_spec as taxels_spec

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
