"""A press that is fed one pose at a time, as fast as the poses come: a sensor that is alive.

    live = LiveSensor(sensor("gelsight"), named("prism"))
    live.move(tip, duration)  # as often as there is time
    live.answer.values, live.answer.slope  # wrench and counts; what a tip that goes on changes

A `simulate` of the same poses knows the whole motion beforehand and keeps every frame; this one
knows the pose that it is told and the one before.
"""

from sim.stream.outlines import LiveMarkers
from sim.stream.stream import GRID, TOLERANCE, Answer, LivePress, LiveSensor, Slope

__all__ = [
    "GRID",
    "TOLERANCE",
    "Answer",
    "LiveMarkers",
    "LivePress",
    "LiveSensor",
    "Slope",
]
