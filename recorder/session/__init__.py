"""Sessions: writing, reading, alignment, recovery and windows of synchronised rows."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recorder.session.align import EXPOSURE, captured, linear, quaternion
    from recorder.session.clocks import clock_lines
    from recorder.session.frames import in_frame, surface_heights
    from recorder.session.loss import loss_lines
    from recorder.session.press_curve import press_curves, save_curves
    from recorder.session.reader import accounts_of
    from recorder.session.sheet import thumbnails
    from recorder.session.uncertainty import sigmas_of, time_lines

__all__ = [
    "EXPOSURE",
    "accounts_of",
    "captured",
    "clock_lines",
    "in_frame",
    "linear",
    "loss_lines",
    "press_curves",
    "quaternion",
    "save_curves",
    "sigmas_of",
    "surface_heights",
    "thumbnails",
    "time_lines",
]

# Module of each name; imported on demand, as a reader needs neither tails nor drawings.
_MODULES = {
    "EXPOSURE": "align",
    "accounts_of": "reader",
    "captured": "align",
    "clock_lines": "clocks",
    "in_frame": "frames",
    "linear": "align",
    "loss_lines": "loss",
    "press_curves": "press_curve",
    "quaternion": "align",
    "save_curves": "press_curve",
    "sigmas_of": "uncertainty",
    "surface_heights": "frames",
    "thumbnails": "sheet",
    "time_lines": "uncertainty",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
