"""Next stage: intervals of the model, from its errors on indenters that it has not seen yet.

The frames are the target's own. What the predicted forces are compared with are not labels of the
target, but the source's at the same place, depth and direction, scaled between the skins as the
training labels were. So an interval contains the errors of the translation and of the model on a
new indenter, not an error of that scaling: that one is the interval's `Scale`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from learning.force.calibrate import Calibration, Wanted, calibrated, presses_of_rows
from learning.force.intervals import Scale
from learning.force.labels import Relabelling
from learning.force.model import ForceModel
from learning.transfer.pairs import labels_by_place
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor

Floats = NDArray[np.float64]


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
    """
    its = archive[target].table
    calibrates = np.isin(np.array(archive.indenters)[its["indenter"]], indenters)
    wanted = Wanted(
        wanted_forces(archive, source, target, compensation),
        f"{source}'s labels at the same place, scaled between the skins",
        scale,
        _source_labels(archive, source, compensation),
    )
    learned = its["seen"] & ~calibrates
    return calibrated(archive, target, model, wanted, calibrates=calibrates, learned=learned)


def wanted_forces(
    archive: MarkerArchive, source: str, target: str, compensation: Relabelling | None
) -> Floats:
    """Return the source's labels at the target's frames (n, 3) [N], scaled; NaN without one."""
    labels = _source_labels(archive, source, compensation)
    return labels_by_place(archive[source].table, labels, archive[target].table)


def _source_labels(archive: MarkerArchive, source: str, compensation: Relabelling | None) -> Floats:
    """Return the scaled labels of indenters that may be learned from (m, 3) [N]; NaN elsewhere."""
    table = archive[source].table
    labels = np.full((len(table["location"]), 3), np.nan)
    rows = np.flatnonzero(table["valid"] & (table["location"] >= 0) & table["seen"])
    own = np.asarray(table["wrench"][rows, :3], np.float64)
    if compensation is not None:
        phase = table["phase"][rows].astype(np.int64)
        own = compensation.forces(rows, own, np.asarray(table["depth"][rows], np.float64), phase)
    labels[rows] = own
    return labels


def forces_at(
    sensor: ArchivedSensor, rows: Sequence[int] | NDArray[np.int64], model: ForceModel
) -> Floats:
    """Return the forces that a model predicts in some rows (n, 3) [N], from their whole presses."""
    table = sensor.table
    keys = np.stack([table[name] for name in ("location", "indenter", "target")], axis=1)
    wanted = np.unique(keys[rows], axis=0)
    whole = (keys[:, None] == wanted[None]).all(axis=-1).any(axis=1) & table["valid"]
    presses = presses_of_rows(sensor, np.flatnonzero(whole), model)
    order = {row: place for place, row in enumerate(presses.rows.tolist())}
    return model.predict(presses)[[order[int(row)] for row in rows]]
