"""Sessions: writing, reading, alignment, recovery and windows of synchronised rows."""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from recorder.session.align import EXPOSURE as EXPOSURE
    from recorder.session.align import captured as captured
    from recorder.session.align import linear as linear
    from recorder.session.clocks import clock_lines as clock_lines
    from recorder.session.columns import Stream as Stream
    from recorder.session.contact_frame import axes_of as axes_of
    from recorder.session.contact_frame import in_frame as in_frame
    from recorder.session.contact_frame import surface_heights as surface_heights
    from recorder.session.frames import resting as resting
    from recorder.session.loss import loss_lines as loss_lines
    from recorder.session.press_curve import press_curves as press_curves
    from recorder.session.press_curve import save_curves as save_curves
    from recorder.session.reader import Session as Session
    from recorder.session.reader import accounts_of as accounts_of
    from recorder.session.sheet import contact_sheet as contact_sheet
    from recorder.session.sheet import thumbnails as thumbnails
    from recorder.session.states import state_lines as state_lines
    from recorder.session.stream_writer import StreamWriter as StreamWriter
    from recorder.session.uncertainty import sigmas_of as sigmas_of
    from recorder.session.uncertainty import time_lines as time_lines
    from recorder.session.writer import SessionWriter as SessionWriter

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
