"""Binary marker images from the pictures and taxels of sessions.

A preset configures the detection (`preset`). `Segmenter` makes masks, `Tracker` follows markers.
`archive_sessions` processes whole sessions.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from learning.markers.build import Built, archive_sessions
    from learning.markers.efficient_sam import EfficientSam
    from learning.markers.frames import taxel_masks
    from learning.markers.segment import (
        CameraPreset,
        Preset,
        Segmenter,
        TaxelPreset,
        grey,
        names,
        preset,
        preset_of_sensor,
        read_preset,
    )
    from learning.markers.track import Track, Tracker

__all__ = [
    "Built",
    "CameraPreset",
    "EfficientSam",
    "Preset",
    "Segmenter",
    "TaxelPreset",
    "Track",
    "Tracker",
    "archive_sessions",
    "grey",
    "names",
    "preset",
    "preset_of_sensor",
    "read_preset",
    "taxel_masks",
]

# Module of each name that is not in `segment`.
_MODULES = {
    "Built": "build",
    "EfficientSam": "efficient_sam",
    "Track": "track",
    "Tracker": "track",
    "archive_sessions": "build",
    "taxel_masks": "frames",
}


def __getattr__(name: str) -> Any:
    """Import a public name on demand, so that counting markers at the bench needs no SciPy."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES.get(name, 'segment')}"), name)
