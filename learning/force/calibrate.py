"""Intervals of a force model, from frames of indenters that it did not learn from."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.compensation.simulated import twin_forces
from learning.data.presses import Presses, load_presses
from learning.force.intervals import (
    NORMAL,
    SHAPE,
    Intervals,
    Scale,
    shapes_of,
    shapes_of_shading,
)
from learning.force.model import ForceModel
from recorder.archive import SHADING, ArchivedSensor
from recorder.markers import unpack

Floats = NDArray[np.float64]

# Masks unpacked at once.
_AT_ONCE = 256
# Frames whose normal force is above this part of the largest give the spread of a twin's forces.
_PRESSED = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class IntervalCalibration:
    """Intervals, and the forces that they were calibrated with."""

    intervals: Intervals
    predicted: Floats
    """Forces (n, 3) by models that had not seen the indenter [N]; NaN on axes without a label."""
    expected: Floats
    """Labels that they are compared with (n, 3) [N]; NaN without one."""
    indenter: NDArray[np.str_]
    """Indenter of each (n,)."""


def scale_of_twin(sensor: ArchivedSensor, rows: NDArray[np.int64]) -> Scale:
    """Return the scale of forces of a twin, by the spread of its normal forces in some rows."""
    twin = twin_forces(sensor)
    size, spread = np.abs(twin.force[rows, 2]), twin.spread[rows, 2]
    pressed = size > _PRESSED * np.nanmax(size, initial=0.0)
    relative = float(np.nanmedian(spread[pressed] / size[pressed])) if pressed.any() else 0.0
    return Scale(math.exp(NORMAL * relative), "the spread of its twin's forces", assumed=False)


def shapes(sensor: ArchivedSensor, rows: NDArray[np.int64]) -> Floats:
    """Return the shapes of frames (n, 7), as `shapes_of` and `shapes_of_shading` do."""
    values = np.zeros((len(rows), SHAPE))
    references = sensor.table["reference"]
    for first in range(0, len(rows), _AT_ONCE):
        part = rows[first : first + _AT_ONCE]
        if sensor.representation == SHADING:
            values[first : first + len(part)] = shapes_of_shading(sensor.frames(part))
            continue
        masks = unpack(sensor.packed(part))
        for number in np.unique(references[part]).tolist():
            own = references[part] == number
            (reference,) = unpack(sensor.references[number : number + 1])
            values[first : first + len(part)][own] = shapes_of(masks[own], reference)
    return values


def presses_of_rows(sensor: ArchivedSensor, rows: NDArray[np.int64], model: ForceModel) -> Presses:
    """Load presses as a model takes them."""
    return load_presses(sensor, rows, device=model.device, form=model.inputs.stored_form)


def largest(labels: Floats) -> tuple[float | None, float | None, float | None]:
    """Return the largest size of Fx, Fy, Fz of labels (n, 3) [N]; None without one."""
    x, y, z = (float(np.nanmax(np.abs(c))) if np.isfinite(c).any() else None for c in labels.T)
    return x, y, z
