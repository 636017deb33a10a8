"""Import of other recordings and export of sessions: one file per format.

The library of a format is imported only when the format is used;
docs/how-to/export-and-import.md describes the content of each format.
"""

from recorder.convert.export import FORMATS as FORMATS
from recorder.convert.export import Options as Options
from recorder.convert.export import export as export
from recorder.convert.genforce_format import DEPTH_UNKNOWN as DEPTH_UNKNOWN
from recorder.convert.genforce_format import FORCE_COLUMNS as FORCE_COLUMNS
from recorder.convert.genforce_format import POSE_COLUMNS as POSE_COLUMNS
from recorder.convert.import_numbers import in_order as in_order
from recorder.convert.import_numbers import order_at_rest as order_at_rest
from recorder.convert.import_page import write_page as write_page
from recorder.convert.import_session import Draft as Draft
from recorder.convert.import_session import draft_recordings as draft_recordings
from recorder.convert.import_session import write_sessions as write_sessions
from recorder.convert.import_tracks import Answers as Answers
from recorder.convert.import_tracks import As as As
from recorder.convert.import_tracks import MissingAnswer as MissingAnswer
from recorder.convert.import_tracks import default_stream as default_stream
from recorder.convert.import_tracks import option_flag as option_flag
from recorder.convert.import_tracks import rate_option as rate_option
