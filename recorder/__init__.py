"""What is on disk: recording, reading, aligning, checking and exporting sessions; archives.

`docs/data-format.md` is the contract; this package is its one implementation.
"""

from recorder import codecs as _codecs
from recorder.archive import MarkerArchive
from recorder.check import check
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.reader import Session, Stream
from recorder.recover import recover
from recorder.repack import repack
from recorder.session import SessionWriter
from recorder.sheet import contact_sheet
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
from recorder.window import Window
from recorder.writer import StreamWriter

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
