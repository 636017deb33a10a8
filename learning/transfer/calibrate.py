"""Next stage: intervals of the model, from its errors on indenters that it has not seen yet.

The frames are the target's own. What the predicted forces are compared with are not labels of the
target, but the source's at the same place, depth and direction, scaled between the skins as the
training labels were. So an interval contains the errors of the translation and of the model on a
new indenter, not an error of that scaling: that one is the interval's `Scale`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.compensation import SimulatedLabels
from learning.data.presses import Presses, load_presses
from learning.errors import LearningError
from learning.force.intervals import FEWEST, AxisError, Intervals, Scale, fit_errors
from learning.force.learned import SHAPE, fit_learned, shapes_of
from learning.force.model import ForceModel
from learning.force.train import Compensation, Relabelling
from learning.transfer.pairs import labels_by_place
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor
from recorder.markers import unpack
from recorder.progress import ItemProgress

Floats = NDArray[np.float64]
# Masks unpacked at once.
_AT_ONCE = 256


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Intervals, and the forces that they were calibrated with."""

    intervals: Intervals
    predicted: Floats
    """Forces (n, 3) that the model predicts on the target's frames of held-out indenters [N]."""
    wanted: Floats
    """The source's forces there (n, 3), scaled between the skins [N]."""
    indenter: NDArray[np.str_]
    """Indenter of each (n,)."""


def calibrate(
    archive: MarkerArchive,
    source: str,
    target: str,
    model: ForceModel,
    compensation: Relabelling | None,
    indenters: tuple[str, ...],
    scale: Scale,
) -> Calibration:
    """Return the intervals of a model of the target.

    Args:
        archive: Presses of both sensors, joined by place.
        source: Sensor with labels.
        target: Sensor of the frames.
        model: Model of the target.
        compensation: Scaling of the labels that the model was trained on.
        indenters: Indenters that calibrate: seen in the archive, never by the model.
        scale: What is known of the scale of its forces.

    Raises:
        LearningError: Too few frames of the target match labels of the source.
        SessionError: The archive is corrupt.
    """
    its = archive[target].table
    wanted = wanted_forces(archive, source, target, compensation)
    names = np.array(archive.indenters)[its["indenter"]]
    calibrates = np.isin(names, indenters)
    with ItemProgress("forces that calibrate", sys.stderr) as progress:
        presses = _presses(archive[target], calibrates & its["valid"], model)
        predicted = model.predict(presses, progress=progress)
    used = presses.rows.numpy()
    axes = fit_errors(predicted, wanted[used], names[used])
    if all(axis is None for axis in axes):
        raise LearningError(
            f"{', '.join(indenters)}: {len(used)} frames of {target}, fewer than {FEWEST} of which "
            f"match a label of {source} on any axis; allowed: more places that both were pressed at"
        )
    learned = (its["location"] >= 0) & its["valid"] & its["seen"] & ~calibrates
    known = np.isfinite(wanted[used]).any(axis=1)
    intervals = Intervals(
        axes=_three(axes),
        scale=scale,
        largest=_largest(_source_labels(archive, source, compensation)),
        learned=fit_learned(
            shapes(archive[target], np.flatnonzero(learned)), shapes(archive[target], used)
        ),
        frames=int(known.sum()),
        indenters=indenters,
        errors_from=f"{source}'s labels at the same place, scaled between the skins",
    )
    return Calibration(intervals, predicted[known], wanted[used][known], names[used][known])


def wanted_forces(
    archive: MarkerArchive, source: str, target: str, compensation: Relabelling | None
) -> Floats:
    """Return the source's labels at the target's frames (n, 3) [N], scaled; NaN without one.

    Raises:
        SessionError: The archive is corrupt.
    """
    labels = _source_labels(archive, source, compensation)
    return labels_by_place(archive[source].table, labels, archive[target].table)


def _source_labels(archive: MarkerArchive, source: str, compensation: Relabelling | None) -> Floats:
    """Return the scaled labels of indenters that may be learned from (m, 3) [N]; NaN elsewhere."""
    table = archive[source].table
    labels = np.full((len(table["location"]), 3), np.nan)
    rows = np.flatnonzero(table["valid"] & (table["location"] >= 0) & table["seen"])
    if isinstance(compensation, SimulatedLabels):
        labels[rows] = compensation.force[rows]
        return labels
    labels[rows] = _scaled(table["wrench"][rows, :3], table, rows, compensation)
    return labels


def shapes(sensor: ArchivedSensor, rows: NDArray[np.int64]) -> Floats:
    """Return the shapes of frames (n, 7), as `shapes_of` does.

    Raises:
        SessionError: The archive is corrupt.
    """
    found = np.zeros((len(rows), SHAPE))
    references = sensor.table["reference"]
    for first in range(0, len(rows), _AT_ONCE):
        part = rows[first : first + _AT_ONCE]
        masks = unpack(sensor.packed(part))
        for number in np.unique(references[part]).tolist():
            own = references[part] == number
            (reference,) = unpack(sensor.references[number : number + 1])
            found[first : first + len(part)][own] = shapes_of(masks[own], reference)
    return found


def presses_of_rows(sensor: ArchivedSensor, rows: NDArray[np.int64], model: ForceModel) -> Presses:
    """Load presses as a model takes them.

    Raises:
        LearningError: Rows repeat or are invalid.
        SessionError: The archive is corrupt.
    """
    return load_presses(sensor, rows, device=model.device, form=model.inputs.stored_form)


def forces_at(
    sensor: ArchivedSensor, rows: Sequence[int] | NDArray[np.int64], model: ForceModel
) -> Floats:
    """Return the forces that a model predicts in some rows (n, 3) [N], from their whole presses.

    Raises:
        SessionError: The archive is corrupt.
    """
    table = sensor.table
    keys = np.stack([table[name] for name in ("location", "indenter", "target")], axis=1)
    wanted = np.unique(keys[rows], axis=0)
    whole = (keys[:, None] == wanted[None]).all(axis=-1).any(axis=1) & table["valid"]
    presses = presses_of_rows(sensor, np.flatnonzero(whole), model)
    order = {row: place for place, row in enumerate(presses.rows.tolist())}
    return model.predict(presses)[[order[int(row)] for row in rows]]


def _presses(sensor: ArchivedSensor, chosen: NDArray[np.bool_], model: ForceModel) -> Presses:
    rows = np.flatnonzero(chosen & (sensor.table["location"] >= 0))
    return presses_of_rows(sensor, rows, model)


def _scaled(
    forces: NDArray[np.floating],
    table: Mapping[str, NDArray[Any]],
    rows: NDArray[np.int64],
    compensation: Compensation | None,
) -> Floats:
    labels = np.asarray(forces, np.float64)
    if compensation is None:
        return labels
    phase = table["phase"][rows].astype(np.int64)
    return compensation(labels, np.asarray(table["depth"][rows], np.float64), phase)[0]


def _largest(labels: Floats) -> tuple[float | None, float | None, float | None]:
    found = [float(np.nanmax(np.abs(c))) if np.isfinite(c).any() else None for c in labels.T]
    return found[0], found[1], found[2]


def _three(
    axes: tuple[AxisError | None, ...],
) -> tuple[AxisError | None, AxisError | None, AxisError | None]:
    x, y, z = axes
    return x, y, z
