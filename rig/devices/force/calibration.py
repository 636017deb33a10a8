"""Conversion between the gauge voltages of an ATI transducer and its wrench in SI units.

The map is linear, so

    wrench = matrix @ (volts - bias volts) = matrix @ volts - bias wrench

and a tare in newton is equivalent to one in volts.
"""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from rig.core.errors import ConfigError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ToolTransform:
    """Frame in which a wrench is reported, relative to the transducer's own."""

    displacement: tuple[float, float, float] = field(
        default=(0.0, 0.0, 0.0), metadata={"unit": "mm"}
    )
    """Origin in the transducer's axes (ATI's Dx Dy Dz) [m]."""
    rotation: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata={"unit": "deg"})
    """Rotations about x, then the new y, then the new z (ATI's Rx Ry Rz) [rad]."""


@dataclass(frozen=True, slots=True)
class TransducerCalibration:
    """Calibration of one transducer, which converts its voltages to a wrench."""

    serial: str
    """Serial number of the transducer, FT and five digits."""
    part: str
    """Name of the calibration, such as SI-12-0.12."""
    matrix: Array
    """(6, 6): N per V in the upper rows, N m per V in the lower."""
    rated: tuple[float, ...]
    """Rated range of each axis (6,) [N, N m]: beyond it, accuracy is not guaranteed."""
    volts_range: tuple[float, float] = (-10.0, 10.0)
    """Output range of the gauges' amplifier [V]."""

    def wrench(self, volts: npt.ArrayLike) -> Array:
        """Return the wrench (..., 6) [N, N m] in the transducer's frame at volts (..., 6)."""
        return np.asarray(volts, np.float64) @ self.matrix.T

    def volts(self, wrench: npt.ArrayLike) -> Array:
        """Return the gauge voltages (..., 6) [V] of a wrench (..., 6) [N, N m], unclipped."""
        return np.asarray(wrench, np.float64) @ np.linalg.inv(self.matrix).T

    def saturated(self, volts: npt.ArrayLike, fraction: float = 0.999) -> npt.NDArray[np.bool_]:
        """Return True where a gauge of volts (..., 6) is beyond this fraction of its range."""
        low, high = self.volts_range
        middle, half = (high + low) / 2, (high - low) / 2
        ends = np.abs(np.asarray(volts, np.float64) - middle) >= fraction * half
        return np.asarray(ends.any(axis=-1))

    def beyond_rating(self, wrench: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return True where any axis of a wrench (..., 6) [N, N m] is beyond its rated range."""
        beyond = np.abs(np.asarray(wrench, np.float64)) > np.array(self.rated)
        return np.asarray(beyond.any(axis=-1))

    def moved(self, tool: ToolTransform) -> Self:
        """Return the calibration of the same transducer in a tool's frame.

        The tool's origin is at d from the transducer's, in the transducer's axes; the axes are then
        rotated: F' = R F, T' = R (T - d x F). The rated ranges stay those of the transducer.
        """
        x, y, z = tool.displacement
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = _turn(tool.rotation)
        force = turn @ self.matrix[:3]
        torque = turn @ (self.matrix[3:] - cross @ self.matrix[:3])
        return replace(self, matrix=np.vstack([force, torque]))


def _turn(rotation: tuple[float, float, float]) -> Array:
    """Return the rotation to axes turned about x, then the new y, then the new z [rad]."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(rotation), np.sin(rotation)
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_z = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


# An ATI calibration file (`.cal`): XML, one `FTSensor` with one `TransducerCalibration` in it.
#
# According to the file's own header, the matrix to use is the `UserAxis` rows, in `ForceUnits` and
# `TorqueUnits` per volt, with the rated range of each axis in `max`; the `Axis` rows are the
# factory's, before its own transform.

# Names of the rows, in the order of a wrench.
AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")

_POUND_FORCE = 4.4482216152605
# Newton per unit (standard gravity and the international pound), by the names ATI uses.
FORCE_UNITS = {
    "N": 1.0,
    "kN": 1e3,
    "lb": _POUND_FORCE,
    "lbf": _POUND_FORCE,
    "klb": 1e3 * _POUND_FORCE,
    "klbf": 1e3 * _POUND_FORCE,
    "kg": 9.80665,
    "kgf": 9.80665,
    "g": 9.80665e-3,
    "gf": 9.80665e-3,
}

_INCH = 0.0254
_TORQUE_UNITS = {
    ("N-m", "Nm"): 1.0,
    ("N-mm", "Nmm"): 1e-3,
    ("kN-m", "kNm"): 1e3,
    ("in-lb", "lb-in", "in-lbf", "lbf-in"): _POUND_FORCE * _INCH,
    ("ft-lb", "lb-ft", "ft-lbf", "lbf-ft"): _POUND_FORCE * 12 * _INCH,
    ("kg-cm", "kgcm", "kgf-cm"): 9.80665e-2,
}
# Newton metre per unit, by the names ATI uses.
TORQUE_UNITS = {name: value for names, value in _TORQUE_UNITS.items() for name in names}

# Output span [V] if a file gives none: an ATI DAQ F/T outputs -10 V to +10 V.
_OUTPUT_RANGE = "20"
_BYTES_MAX = 1 << 20
# Limit for the matrix in rated loads per volt. A real one has a few tens; a repeated row, infinity.
_CONDITION_MAX = 1e6


def read_calibration(path: Path) -> TransducerCalibration:
    """Read the calibration in a `.cal` file."""
    try:
        with path.open("rb") as file:
            content = file.read(_BYTES_MAX + 1)
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror or error}; allowed: the .cal file on the CD or USB stick of "
            "the transducer, as a path from the folder this is run in"
        ) from None
    return parse_calibration(content, str(path))


def parse_calibration(content: bytes, where: str) -> TransducerCalibration:
    """Parse the content of a `.cal` file, which errors call `where`."""
    root = _root(content, where)
    gauges = _attribute(root, "NumGages", f"{where}.FTSensor")
    if gauges.strip() != "6":
        raise ConfigError(f"{where}.FTSensor.NumGages: found {gauges!r}; allowed: '6'")
    elements = root.findall("Calibration")
    if len(elements) != 1:
        raise ConfigError(f"{where}.Calibration: found {len(elements)}; allowed: 1")
    (element,) = elements
    where = f"{where}.Calibration"
    scale = np.repeat(
        [
            _unit(element, "ForceUnits", FORCE_UNITS, where),
            _unit(element, "TorqueUnits", TORQUE_UNITS, where),
        ],
        3,
    )
    rows = _rows(element, where)
    matrix = np.array([rows[axis][0] for axis in AXES]) * scale[:, np.newaxis]
    rated = np.array([rows[axis][1] for axis in AXES]) * scale
    with np.errstate(all="ignore"):
        condition = np.linalg.cond(matrix / rated[:, np.newaxis])
    if not condition < _CONDITION_MAX:
        raise ConfigError(
            f"{where}.UserAxis: the six rows do not determine six components (condition number "
            f"{condition:.3g}); allowed: below {_CONDITION_MAX:.0e}; is the file damaged?"
        )
    span = _number(element.get("OutputRange", _OUTPUT_RANGE), f"{where}.OutputRange")
    if span <= 0:
        raise ConfigError(f"{where}.OutputRange: found {span:g}; allowed: above 0 V")
    bipolar = element.get("OutputBipolar", "True").strip().lower()
    if bipolar not in ("true", "false"):
        raise ConfigError(f"{where}.OutputBipolar: found {bipolar!r}; allowed: True, False")
    return TransducerCalibration(
        serial=_attribute(root, "Serial", where),
        part=element.get("PartNumber", ""),
        matrix=matrix,
        rated=tuple(rated.tolist()),
        volts_range=(-span / 2, span / 2) if bipolar == "true" else (0.0, span),
    )


class _NoDoctype(ET.TreeBuilder):
    """Builder that rejects document types: only they declare entities to expand or fetch."""

    def doctype(self, name: str, pubid: str, system: str) -> None:
        raise ConfigError(f"has a document type ({name})")


def _root(content: bytes, where: str) -> ET.Element:
    allowed = "allowed: the XML of an ATI .cal file"
    if len(content) > _BYTES_MAX:
        raise ConfigError(f"{where}: more than {_BYTES_MAX} bytes; {allowed}")
    parser = ET.XMLParser(target=_NoDoctype())
    try:
        parser.feed(content)
        root: ET.Element = parser.close()
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}; {allowed}, which has none") from None
    except (ET.ParseError, LookupError, ValueError) as error:
        raise ConfigError(f"{where}: not XML: {error}; {allowed}") from None
    if root.tag != "FTSensor":
        raise ConfigError(f"{where}: found <{root.tag}>; allowed: <FTSensor>")
    return root


def _rows(element: ET.Element, where: str) -> dict[str, tuple[list[float], float]]:
    """Return the values and rated range of each axis, in the file's units."""
    axes: dict[str, tuple[list[float], float]] = {}
    for row in element.findall("UserAxis"):
        name = _attribute(row, "Name", f"{where}.UserAxis")
        key_path = f"{where}.UserAxis[{name}]"
        if name not in AXES or name in axes:
            raise ConfigError(
                f"{key_path}: found {name!r}; allowed: each of {', '.join(AXES)} once"
            )
        texts = _attribute(row, "values", key_path).split()
        if len(texts) != 6:
            raise ConfigError(f"{key_path}.values: found {len(texts)}; allowed: 6, one per gauge")
        values = [_number(text, f"{key_path}.values") for text in texts]
        most = _number(_attribute(row, "max", key_path), f"{key_path}.max")
        if most <= 0:
            raise ConfigError(f"{key_path}.max: found {most:g}; allowed: above 0")
        axes[name] = values, most
    if missing := [axis for axis in AXES if axis not in axes]:
        raise ConfigError(f"{where}.UserAxis: missing {missing}; allowed: {', '.join(AXES)}")
    return axes


def _unit(element: ET.Element, name: str, table: dict[str, float], where: str) -> float:
    unit = _attribute(element, name, where).strip()
    if unit not in table:
        raise ConfigError(f"{where}.{name}: found {unit!r}; allowed: {', '.join(sorted(table))}")
    return table[unit]


def _attribute(element: ET.Element, name: str, where: str) -> str:
    text = element.get(name)
    if text is None:
        raise ConfigError(f"{where}: missing '{name}'; found {sorted(element.keys())}")
    return text


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{where}: found {text!r}; allowed: a finite number")
    return value
