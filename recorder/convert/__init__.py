"""Import of other recordings and export of sessions: one file per format.

The library of a format is imported only when the format is used;
docs/how-to/export-and-import.md describes the content of each format.
"""

from recorder.convert.export import FORMATS, Options, export
from recorder.convert.genforce_format import DEPTH_UNKNOWN, FORCE_COLUMNS, POSE_COLUMNS
from recorder.convert.import_numbers import in_order, order_at_rest
from recorder.convert.import_page import write_page
from recorder.convert.import_session import Draft, draft_recordings, write_sessions
from recorder.convert.import_tracks import (
    Answers,
    As,
    MissingAnswer,
    default_stream,
    option_flag,
    rate_option,
)

__all__ = [
    "DEPTH_UNKNOWN",
    "FORCE_COLUMNS",
    "FORMATS",
    "POSE_COLUMNS",
    "Answers",
    "As",
    "Draft",
    "MissingAnswer",
    "Options",
    "default_stream",
    "draft_recordings",
    "export",
    "in_order",
    "option_flag",
    "order_at_rest",
    "rate_option",
    "write_page",
    "write_sessions",
]
