"""ATI calibration files (`.cal`) of made-up transducers."""

import xml.etree.ElementTree as ET

import numpy as np

from rig.devices.force.calibration import AXES, FORCE_UNITS, TORQUE_UNITS, TransducerCalibration


def emit_calibration(
    calibration: TransducerCalibration, *, force_unit: str = "N", torque_unit: str = "N-mm"
) -> bytes:
    """Return a `.cal` file of a bipolar `calibration`, as `parse_calibration` reads it."""
    scale = np.repeat([FORCE_UNITS[force_unit], TORQUE_UNITS[torque_unit]], 3)
    matrix = calibration.matrix / scale[:, np.newaxis]
    rated = np.array(calibration.rated) / scale
    root = ET.Element("FTSensor", Serial=calibration.serial, BodyStyle="Nano17", Family="DAQ")
    root.set("NumGages", "6")
    low, high = calibration.volts_range
    element = ET.SubElement(
        root,
        "Calibration",
        PartNumber=calibration.part,
        CalDate="1/1/2000",
        ForceUnits=force_unit,
        TorqueUnits=torque_unit,
        DistUnits="m",
        OutputMode="Ground Referenced Differential",
        OutputRange=f"{high - low:g}",
        OutputBipolar="True",
        HWTempComp="True",
        GainMultiplier="1",
    )
    for kind in ("Axis", "UserAxis"):
        for axis, row, most in zip(AXES, matrix, rated, strict=True):
            values = " ".join(f"{value:.12g}" for value in row)
            ET.SubElement(element, kind, Name=axis, values=values, max=f"{most:.12g}")
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"
