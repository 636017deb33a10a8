"""The turn of a sensor against the robot, from the markers of its sheared presses.

While a pressed indenter moves sideways, the markers under it move along. So the shear of the poses,
turned into the image, is the motion of the markers but for its size. A mirrored image cannot be
turned into place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.data.genforce.format import GenForcePress, Packed, ReadMask
from learning.errors import LearningError
from learning.markers.track import Tracker
from recorder.markers import marker_centres, unpack
from recorder.spec import PHASES

Floats = NDArray[np.float64]

# Number of presses compared, evenly spaced; fewer than FEWEST give no turn.
_PRESSES, _FEWEST = 24, 4
# Largest standard error of a turn [deg], and residual of motions over their size.
_ERROR_DEG, _RESIDUAL = 1.0, 0.3
# Times by which a mirrored (or unmirrored) turn must fit worse than the chosen one.
_WORSE = 2.0


@dataclass(frozen=True, slots=True)
class Turn:
    """Angle from the robot's x axis to the image's, counter-clockwise."""

    angle: float
    """Angle [rad]."""
    error: float
    """Its standard error [rad]."""
    presses: int
    """Number of sheared presses that it was found by."""

    def __str__(self) -> str:
        return (
            f"{math.degrees(self.angle):.2f} deg into the image, found by the markers of "
            f"{self.presses} sheared presses to {math.degrees(self.error):.2f} deg"
        )


def turn_of(
    name: str, presses: Sequence[GenForcePress], references: Packed, read: ReadMask
) -> Turn | None:
    """Return the turn of a sensor; None if its presses do not determine it.

    The presses have positions along the axes of the robot; `references` are packed masks without
    contact (K, 38400).
    """
    sheared = [(press, ends) for press in presses if (ends := _ends(press)) is not None]
    chosen = np.unique(np.linspace(0, len(sheared) - 1, _PRESSES).round().astype(int))
    shears, motions = [], []
    trackers: dict[int, Tracker] = {}
    for press, ends in (sheared[index] for index in chosen.tolist() if sheared):
        if press.reference not in trackers:
            (reference,) = unpack(references[press.reference : press.reference + 1])
            trackers[press.reference] = Tracker(marker_centres(reference))
        tracker = trackers[press.reference]
        tracker.restart()
        positions = []
        for frame in ends:
            (mask,) = unpack(read(press.files[frame])[None])
            positions.append(tracker.step(marker_centres(mask)).place)
        moved = positions[1] - positions[0]
        if np.isfinite(moved).any():
            shears.append(press.position[ends[1]] - press.position[ends[0]])
            motions.append(np.nanmean(moved, axis=0) * (1, -1))  # rows point down
    return fitted_turn(name, np.reshape(shears, (-1, 2)), np.reshape(motions, (-1, 2)))


def fitted_turn(name: str, shears: Floats, motions: Floats) -> Turn | None:
    """Return the turn from shears (n, 2) to motions (n, 2), y up; None if they do not agree."""
    if len(shears) < _FEWEST:
        return None
    shear, motion = (values[:, 0] + 1j * values[:, 1] for values in (shears, motions))
    size = np.linalg.norm(motions)
    turned, mirrored = (
        np.linalg.norm(motion - each * np.vdot(each, motion) / max(np.vdot(each, each).real, 1e-30))
        for each in (shear, shear.conj())
    )
    if size == 0 or min(turned, mirrored) > _RESIDUAL * size:
        return None
    if turned > _WORSE * mirrored:
        raise LearningError(
            f"{name}: its images are mirrored against the poses of the robot: sheared presses move "
            "the markers like a mirrored shear; allowed: images as the camera saw them, or --turn "
            "SENSOR=DEG if the poses are to be used as they are"
        )
    if mirrored < _WORSE * turned:
        return None
    each = np.angle(motion * shear.conj() * np.exp(-1j * np.angle(np.vdot(shear, motion))))
    angle = -float(np.angle(np.vdot(shear, motion)))
    error = float(np.std(each, ddof=1)) / math.sqrt(len(each))
    return Turn(angle, error, len(each)) if math.degrees(error) <= _ERROR_DEG else None


def _ends(press: GenForcePress) -> tuple[int, int] | None:
    """Return the frames at the beginning and at the end of the shear; None without."""
    sheared = np.flatnonzero(press.phase == PHASES.index("shear_inc"))
    if not len(sheared) or sheared[0] == 0:
        return None
    begin, end = int(sheared[0]) - 1, int(sheared[-1])
    if not np.linalg.norm(press.position[end] - press.position[begin]) > 0:
        return None
    return begin, end
