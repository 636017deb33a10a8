"""Import of other recordings and export of sessions: one file per format.

The library of a format is imported only when the format is used;
docs/how-to/export-and-import.md describes the content of each format.
"""

from recorder.convert.export import FORMATS, Options, building, export, file_name
from recorder.convert.genforce_format import FORCE_COLUMNS, POSE_COLUMNS
from recorder.convert.import_session import ImportRequest, import_session
from recorder.convert.import_taxels import in_order, told_order

__all__ = [
    "FORCE_COLUMNS",
    "FORMATS",
    "POSE_COLUMNS",
    "ImportRequest",
    "Options",
    "building",
    "export",
    "file_name",
    "import_session",
    "in_order",
    "told_order",
]
