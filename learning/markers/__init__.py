"""Binary marker images from the pictures and taxels of sessions.

A preset configures the detection (`preset`). `Segmenter` makes masks, `find_centres` locates
markers with subpixel accuracy, `Tracker` follows them. `archive_sessions` processes whole sessions.
"""

from learning.markers.build import Built, archive_sessions
from learning.markers.efficient_sam import EfficientSam
from learning.markers.frames import taxel_masks
from learning.markers.segment import (
    CameraPreset,
    Centres,
    Preset,
    Segmenter,
    TaxelPreset,
    find_centres,
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
    "Centres",
    "EfficientSam",
    "Preset",
    "Segmenter",
    "TaxelPreset",
    "Track",
    "Tracker",
    "archive_sessions",
    "find_centres",
    "grey",
    "names",
    "preset",
    "preset_of_sensor",
    "read_preset",
    "taxel_masks",
]
