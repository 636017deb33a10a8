"""Binary marker images from the pictures and taxels of sessions.

A preset configures the detection (`preset`). `Segmenter` makes masks, `track.Tracker` follows
markers. `build.archive_sessions` processes whole sessions.
"""

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

__all__ = [
    "CameraPreset",
    "Preset",
    "Segmenter",
    "TaxelPreset",
    "grey",
    "names",
    "preset",
    "preset_of_sensor",
    "read_preset",
]
