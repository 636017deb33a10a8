"""Sessions: writing, reading, alignment, recovery and windows of synchronised rows."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from recorder.session.align import EXPOSURE, Window, captured, linear, quaternion
from recorder.session.clocks import clock_lines
from recorder.session.columns import Stream
from recorder.session.frames import axes_of, in_frame, surface_heights
from recorder.session.loss import loss_lines
from recorder.session.reader import Session, accounts_of
from recorder.session.states import state_lines
from recorder.session.stream_writer import StreamWriter
from recorder.session.uncertainty import sigmas_of, time_lines
from recorder.session.writer import SessionWriter

if TYPE_CHECKING:
    from recorder.session.press_curve import press_curves, save_curves
    from recorder.session.sheet import contact_sheet, thumbnails

__all__ = [
    "EXPOSURE",
    "Session",
    "SessionWriter",
    "Stream",
    "StreamWriter",
    "Window",
    "accounts_of",
    "axes_of",
    "captured",
    "clock_lines",
    "contact_sheet",
    "in_frame",
    "linear",
    "loss_lines",
    "press_curves",
    "quaternion",
    "save_curves",
    "sigmas_of",
    "state_lines",
    "surface_heights",
    "thumbnails",
    "time_lines",
]

# Module of each drawing; imported on demand, since only these need Pillow.
_DRAWINGS = {
    "contact_sheet": "sheet",
    "press_curves": "press_curve",
    "save_curves": "press_curve",
    "thumbnails": "sheet",
}


def __getattr__(name: str) -> Any:
    if name not in _DRAWINGS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DRAWINGS[name]}"), name)
