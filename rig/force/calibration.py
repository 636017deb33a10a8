"""What turns the gauge voltages of an ATI transducer into its wrench, in SI, and back.

The map is linear, so

    wrench = matrix @ (volts - bias volts) = matrix @ volts - bias wrench

and a tare in newton is the same as one in volts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rig.force.config import ToolTransform

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Calibration:
    """What turns the voltages of one transducer into its wrench."""

    serial: str
    """Serial number of the transducer, FT and five digits."""
    part: str
    """Which of its calibrations: SI-12-0.12 and the like."""
    matrix: Array
    """(6, 6): N per V in the upper rows, N m per V in the lower."""
    rated: tuple[float, ...]
    """Rated range of each axis (6,) [N, N m]: beyond it, accuracy is not promised."""
    volts_range: tuple[float, float] = (-10.0, 10.0)
    """What the gauges' amplifier can put out [V]."""

    def wrench(self, volts: npt.ArrayLike) -> Array:
        """Force and torque (..., 6) [N, N m] in the transducer's frame, from volts (..., 6)."""
        found: Array = np.asarray(volts, np.float64) @ self.matrix.T
        return found

    def volts(self, wrench: npt.ArrayLike) -> Array:
        """Gauge voltages (..., 6) [V] that a wrench (..., 6) [N, N m] would give, unclipped."""
        found: Array = np.asarray(wrench, np.float64) @ np.linalg.inv(self.matrix).T
        return found

    def saturated(self, volts: npt.ArrayLike, fraction: float = 0.999) -> npt.NDArray[np.bool_]:
        """Whether any gauge of volts (..., 6) is at the end of its output: the wrench is wrong.

        Args:
            volts: Gauge voltages [V].
            fraction: Of the output range, from where a gauge counts as being at its end.
        """
        low, high = self.volts_range
        middle, half = (high + low) / 2, (high - low) / 2
        ends = np.abs(np.asarray(volts, np.float64) - middle) >= fraction * half
        return np.asarray(ends.any(axis=-1))

    def beyond_rating(self, wrench: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether any axis of a wrench (..., 6) [N, N m] is beyond its rated range."""
        beyond = np.abs(np.asarray(wrench, np.float64)) > np.array(self.rated)
        return np.asarray(beyond.any(axis=-1))

    def moved(self, tool: ToolTransform) -> Calibration:
        """The same transducer read in a tool's frame.

        The tool's origin is d from the transducer's, in the transducer's axes; the axes are then
        turned: F' = R F, T' = R (T - d x F). The rated ranges stay those of the transducer.
        """
        x, y, z = tool.displacement
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = _turn(tool.rotation)
        force = turn @ self.matrix[:3]
        torque = turn @ (self.matrix[3:] - cross @ self.matrix[:3])
        return replace(self, matrix=np.vstack([force, torque]))


def _turn(rotation: tuple[float, float, float]) -> Array:
    """Coordinates in axes turned about x, then y, then z of the axes as turned so far [rad]."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(rotation), np.sin(rotation)
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_z = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
    turn: Array = about_z @ about_y @ about_x
    return turn
