"""Simulated sensors: rows of data with a soft body, its effects and its signal.

    each = sensor("uskin")
    result = simulate(each.scene(named("prism"), press([1e-3])), Layer())
    masks = readout(each).masks(SurfaceField.of(result))

Every signal is computed from the displacement of the top alone, so that sensors can share a
deformation. Assumptions and sources are in docs/reference/sensors.md.
"""

from sim.sensors.field import SurfaceField
from sim.sensors.pins import Pins
from sim.sensors.posterior import Posterior
from sim.sensors.readout import CameraReadout, TaxelReadout, readout
from sim.sensors.sensor import (
    HETEROGENEOUS,
    HOMOGENEOUS,
    MATERIAL,
    NAMES,
    CameraSignal,
    SimulatedSensor,
    read_sensor,
    sensor,
    sensor_of,
)
from sim.sensors.taxels import TaxelPad, TaxelSignal
from sim.sensors.variation import (
    DeviceVariation,
    Drift,
    Framing,
    Grip,
    Mount,
    Placement,
    Segmentation,
    SegmentationErrors,
)

__all__ = [
    "HETEROGENEOUS",
    "HOMOGENEOUS",
    "MATERIAL",
    "NAMES",
    "CameraReadout",
    "CameraSignal",
    "DeviceVariation",
    "Drift",
    "Framing",
    "Grip",
    "Mount",
    "Pins",
    "Placement",
    "Posterior",
    "Segmentation",
    "SegmentationErrors",
    "SimulatedSensor",
    "SurfaceField",
    "TaxelPad",
    "TaxelReadout",
    "TaxelSignal",
    "read_sensor",
    "readout",
    "sensor",
    "sensor_of",
]
