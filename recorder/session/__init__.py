"""Sessions: writing, reading, alignment, recovery and windows of synchronised rows."""

from recorder.session.accounts import Account, accounts_of, loss_lines
from recorder.session.align import EXPOSURE, captured, linear, quaternion
from recorder.session.clocks import clock_lines, fit_clocks
from recorder.session.columns import Stream
from recorder.session.frames import in_frame, surface_heights
from recorder.session.press_curve import press_curves, save_curves
from recorder.session.sheet import contact_sheet, thumbnails
from recorder.session.tail import ImageTail, open_tail
from recorder.session.uncertainty import PRIOR, sigmas_of, time_lines

__all__ = [
    "EXPOSURE",
    "PRIOR",
    "Account",
    "ImageTail",
    "Stream",
    "accounts_of",
    "captured",
    "clock_lines",
    "contact_sheet",
    "fit_clocks",
    "in_frame",
    "linear",
    "loss_lines",
    "open_tail",
    "press_curves",
    "quaternion",
    "save_curves",
    "sigmas_of",
    "surface_heights",
    "thumbnails",
    "time_lines",
]
