"""Recordings made elsewhere in, sessions for other programs out: one file a format.

Every format's library is imported only when it is asked for; docs/exporting.md says what each
format keeps.
"""

from recorder.convert.export import FORMATS, Options, export
from recorder.convert.import_session import ImportOrder, import_session

__all__ = ["FORMATS", "ImportOrder", "Options", "export", "import_session"]
