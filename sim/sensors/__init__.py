"""Sensors: rows of data that say what is soft, what acts on it, and what is measured of it.

    each = sensor("uskin")
    result = simulate(each.scene(named("prism"), press([1e-3])), tier="layer")
    masks = readout(each).masks(SurfaceField.of(result))

One deformation serves them all: a signal is made from the displacement of the top alone. What they
assume, and where from: docs/sensors.md.
"""

from sim.sensors.field import EVEN_STEP, SurfaceField, cubic_weights
from sim.sensors.optics import Lamp, Pins, Shading
from sim.sensors.readout import CameraReadout, Readout, TaxelReadout, readout
from sim.sensors.sensor import (
    HETEROGENEOUS,
    HOMOGENEOUS,
    MATERIAL,
    NAMES,
    CameraSignal,
    SimulatedSensor,
    read_sensor,
    sensor,
)
from sim.sensors.taxels import TaxelPad, TaxelSignal
from sim.sensors.variation import (
    Drift,
    Framing,
    Grip,
    Life,
    Mount,
    Placement,
    Segmentation,
    Segmenter,
)

__all__ = [
    "EVEN_STEP",
    "HETEROGENEOUS",
    "HOMOGENEOUS",
    "MATERIAL",
    "NAMES",
    "CameraReadout",
    "CameraSignal",
    "Drift",
    "Framing",
    "Grip",
    "Lamp",
    "Life",
    "Mount",
    "Pins",
    "Placement",
    "Readout",
    "Segmentation",
    "Segmenter",
    "Shading",
    "SimulatedSensor",
    "SurfaceField",
    "TaxelPad",
    "TaxelReadout",
    "TaxelSignal",
    "cubic_weights",
    "read_sensor",
    "readout",
    "sensor",
]
