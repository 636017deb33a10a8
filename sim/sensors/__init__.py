"""Sensors: rows of data that say what is soft, what acts on it, and what is measured of it.

    each = sensor("uskin")
    result = simulate(each.scene(named("prism"), press([1e-3])), tier="layer")
    masks = readout(each).masks(SurfaceField.of(result))

One deformation serves them all: a signal is made from the displacement of the top alone. What they
assume, and where from: docs/sensors.md.
"""

from sim.sensors.catalogue import HETEROGENEOUS, HOMOGENEOUS, MATERIAL, NAMES, read_sensor, sensor
from sim.sensors.field import SurfaceField
from sim.sensors.life import Drift, Framing, Grip, Life, Mount, Placement
from sim.sensors.pins import Pins
from sim.sensors.readout import CameraReadout, Readout, TaxelReadout, readout
from sim.sensors.segmentation import Segmentation, Segmenter
from sim.sensors.sensor import CameraSignal, SimulatedSensor
from sim.sensors.shading import Lamp, Shading
from sim.sensors.taxels import TaxelPad, TaxelSignal

__all__ = [
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
    "read_sensor",
    "readout",
    "sensor",
]
