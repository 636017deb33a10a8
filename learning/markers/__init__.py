"""Binary marker images from the pictures and taxels of sessions.

A preset configures the detection (`preset`). `Segmenter` makes masks, `track.Tracker` follows
markers. `build.archive_sessions` processes whole sessions.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from learning.markers.segment import CameraPreset as CameraPreset
    from learning.markers.segment import Preset as Preset
    from learning.markers.segment import Segmenter as Segmenter
    from learning.markers.segment import TaxelPreset as TaxelPreset
    from learning.markers.segment import grey as grey
    from learning.markers.segment import names as names
    from learning.markers.segment import preset as preset
    from learning.markers.segment import preset_of_sensor as preset_of_sensor
    from learning.markers.segment import read_preset as read_preset

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
