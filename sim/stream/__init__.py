"""Live simulation of a sensor: a press that receives one pose at a time.

    live = LiveSensor(sensor("gelsight"), named("prism"))
    live.move(tip, duration)  # as often as there is time
    live.answer.values, live.answer.slope  # wrench and counts; their derivative by the tip

`simulate` knows the whole motion beforehand and keeps every frame; a live sensor knows only the
current pose and the one before.
"""

from sim.stream.outlines import LiveMarkers as LiveMarkers
from sim.stream.outlines import Sampler as Sampler
from sim.stream.stream import LivePress as LivePress
from sim.stream.stream import LiveSensor as LiveSensor
from sim.stream.stream import Slope as Slope
