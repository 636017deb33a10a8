"""Dataset store: record, read, align, check and export sessions; read marker archives.

The format is specified in `docs/reference/data-format.md`; this package is its only implementation.
"""

from recorder.archive import MarkerArchive
from recorder.check.check import check
from recorder.convert.repack import repack
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.session.reader import Session, Stream
from recorder.session.recover import recover
from recorder.session.sheet import contact_sheet
from recorder.session.stream_writer import StreamWriter
from recorder.session.window import Window
from recorder.session.writer import SessionWriter
from recorder.spec import (
    FORMAT_VERSION,
    OUTCOMES,
    PHASES,
    REFERENCE,
    SEGMENTS,
    Column,
    StreamSpec,
    camera_spec,
    force_spec,
    pose_spec,
    taxels_spec,
)
from recorder.store import images as _codecs

_codecs.register()

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
    "Window",
    "camera_spec",
    "check",
    "contact_sheet",
    "force_spec",
    "pose_spec",
    "recover",
    "repack",
    "taxels_spec",
]
