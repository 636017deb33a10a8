"""Recordings made elsewhere in, sessions for other programs out: one file a format.

Every format's library is imported only when it is asked for; docs/exporting.md says what each
format keeps.
"""

from recorder.convert.export import FORMATS, Options, building, export, file_name
from recorder.convert.genforce_format import FORCE_COLUMNS, POSE_COLUMNS
from recorder.convert.import_session import ImportOrder, import_session

__all__ = [
    "FORCE_COLUMNS",
    "FORMATS",
    "POSE_COLUMNS",
    "ImportOrder",
    "Options",
    "building",
    "export",
    "file_name",
    "import_session",
]
