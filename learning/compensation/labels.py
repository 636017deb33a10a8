"""Labels of two sensors of an archive at the same locations, from presses models may learn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.compensation.choosing import Paired
from learning.errors import LearningError
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor, location_pairs


def paired_labels(
    archive: MarkerArchive, source: str, target: str, split: Path | None = None
) -> Paired | None:
    """Return labels of location pairs; None where one of the sensors has none.

    Taken are the last frames of the phases, of presses that the split trains on, or of all seen
    indenters without a split.

    Args:
        archive: The archive.
        source: Name of the sensor that labels are of.
        target: Name of the sensor that they are for.
        split: File of a split.

    Raises:
        LearningError: A split of another archive.
        SessionError: A damaged archive.
    """
    one, other = archive[source], archive[target]
    pairs = location_pairs(one.table, other.table)
    kept = _learned_from(archive, one, pairs.source, split)
    forces = one.table["wrench"][pairs.source, :3], other.table["wrench"][pairs.target, :3]
    for values in forces:
        kept &= np.isfinite(values).all(axis=1)
    if not kept.any():
        return None
    return Paired(
        forces[0][kept],
        forces[1][kept],
        one.table["depth"][pairs.source][kept],
        one.table["phase"][pairs.source][kept].astype(np.int64),
    )


def depth_range(sensor: ArchivedSensor) -> float | None:
    """Return the deepest of a sensor's located presses [m]; None without any."""
    rows = (sensor.table["location"] >= 0) & sensor.table["valid"]
    deepest = float(sensor.table["depth"][rows].max(initial=0.0))
    return deepest if deepest > 0 else None


def _learned_from(
    archive: MarkerArchive, sensor: ArchivedSensor, rows: NDArray[np.int64], split: Path | None
) -> NDArray[np.bool_]:
    if split is None:
        return np.asarray(sensor.table["seen"][rows], np.bool_)
    from learning.data.splits import read_split

    found = read_split(split)
    found.check(archive)
    roles = np.asarray(found.role(sensor.table["location"][rows]))
    kept = np.asarray(roles == "train", np.bool_)
    if not kept.any():
        raise LearningError(f"{split}: trains on no press of {sensor.name}; allowed: one or more")
    return kept
