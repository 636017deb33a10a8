"""Simulated sensors: rows of data with a soft body, its effects and its signal.

    each = sensor("uskin")
    result = simulate(each.scene(named("prism"), press([1e-3])), Layer())
    masks = readout(each).masks(SurfaceField.of(result))

Every signal is computed from the displacement of the top alone, so that sensors can share a
deformation. Assumptions and sources are in docs/reference/sensors.md.
"""

from sim.sensors.field import SurfaceField as SurfaceField
from sim.sensors.pins import Pins as Pins
from sim.sensors.posterior import Posterior as Posterior
from sim.sensors.readout import CameraReadout as CameraReadout
from sim.sensors.readout import TaxelReadout as TaxelReadout
from sim.sensors.readout import readout as readout
from sim.sensors.sensor import HETEROGENEOUS as HETEROGENEOUS
from sim.sensors.sensor import HOMOGENEOUS as HOMOGENEOUS
from sim.sensors.sensor import MATERIAL as MATERIAL
from sim.sensors.sensor import NAMES as NAMES
from sim.sensors.sensor import CameraSignal as CameraSignal
from sim.sensors.sensor import SimulatedSensor as SimulatedSensor
from sim.sensors.sensor import read_sensor as read_sensor
from sim.sensors.sensor import sensor as sensor
from sim.sensors.sensor import sensor_of as sensor_of
from sim.sensors.taxels import TaxelPad as TaxelPad
from sim.sensors.taxels import TaxelSignal as TaxelSignal
from sim.sensors.variation import DeviceVariation as DeviceVariation
from sim.sensors.variation import Drift as Drift
from sim.sensors.variation import Framing as Framing
from sim.sensors.variation import Grip as Grip
from sim.sensors.variation import Mount as Mount
from sim.sensors.variation import Placement as Placement
from sim.sensors.variation import Segmentation as Segmentation
from sim.sensors.variation import SegmentationErrors as SegmentationErrors
