"""Dataset store: record, read, align, check and export sessions; read marker archives.

The format is specified in `docs/reference/data-format.md`; this package is its only implementation.
A public name is imported when it is first used: progress and settings need neither Zarr nor NumPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recorder.archive import MarkerArchive
    from recorder.checks.check import check
    from recorder.checks.plausible import doubts
    from recorder.checks.recover import recover
    from recorder.errors import SessionError
    from recorder.findings import Finding, faults
    from recorder.session.align import Window
    from recorder.session.columns import Stream
    from recorder.session.reader import Session
    from recorder.session.sheet import contact_sheet
    from recorder.session.stream_writer import StreamWriter
    from recorder.session.tables import to_pandas, to_xarray
    from recorder.session.writer import SessionWriter
    from recorder.spec import (
        FORMAT_VERSION,
        OUTCOMES,
        PHASES,
        REFERENCE,
        SEGMENTS,
        Column,
        StreamSpec,
        Traits,
        arm_wrench_spec,
        camera_spec,
        depth_spec,
        event_row,
        event_text,
        events_spec,
        force_spec,
        joints_spec,
        pose_spec,
        taxels_spec,
    )

__all__ = [
    "FORMAT_VERSION",
    "OUTCOMES",
    "PHASES",
    "REFERENCE",
    "SEGMENTS",
    "Column",
    "Finding",
    "MarkerArchive",
    "Session",
    "SessionError",
    "SessionWriter",
    "Stream",
    "StreamSpec",
    "StreamWriter",
    "Traits",
    "Window",
    "arm_wrench_spec",
    "camera_spec",
    "check",
    "contact_sheet",
    "depth_spec",
    "doubts",
    "event_row",
    "event_text",
    "events_spec",
    "faults",
    "force_spec",
    "joints_spec",
    "pose_spec",
    "recover",
    "taxels_spec",
    "to_pandas",
    "to_xarray",
]

# Module of each name that is not in `spec`.
_MODULES = {
    "Finding": "findings",
    "MarkerArchive": "archive",
    "Session": "session.reader",
    "SessionError": "errors",
    "SessionWriter": "session.writer",
    "Stream": "session.columns",
    "StreamWriter": "session.stream_writer",
    "Window": "session.align",
    "check": "checks.check",
    "contact_sheet": "session.sheet",
    "doubts": "checks.plausible",
    "faults": "findings",
    "recover": "checks.recover",
    "to_pandas": "session.tables",
    "to_xarray": "session.tables",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES.get(name, 'spec')}"), name)


def __dir__() -> list[str]:
    return __all__
