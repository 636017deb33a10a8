"""Labels by simulation: labels of one sensor for another, from forces of the twins of both.

`tactile sim labels` adds a twin's forces to a sensor of an archive. A label f of the source becomes

    T + g (f - S)

with the forces T and S of the twins of target and source in the same press, and their ratio g: of
Fz for Fz, of the shear's size for the shear. Fz is thus f times T / S.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.compensation.search import label_r2, training_mask
from learning.errors import LearningError
from recorder.archive import ArchivedSensor, MarkerArchive, Simulated, location_pairs, press_rows

Floats = NDArray[np.float64]

# Name of such labels among methods and choices.
SIMULATED = "simulated"
# Limits of ratios, as of those of priors, and the least force that has a ratio [N].
RATIOS, LEAST_FORCE = (0.1, 10.0), 0.01


def simulated_labels(source: ArchivedSensor, target: ArchivedSensor) -> Simulated:
    """Return the labels of a source's frames for a target, whose own labels are not read.

    Frames meet at the same place and phase, and the same fraction of the phase. Without a press of
    both, labels are NaN; their spread is that of both twins.
    """
    own, other = twin_forces(source), twin_forces(target)
    shape = (len(source), 3)
    there, off = np.full(shape, np.nan), np.full(shape, np.nan)
    groups = _groups(target)
    for key, (rows, fraction) in _groups(source).items():
        if key not in groups:
            continue
        others, at = groups[key]
        for axis in range(3):
            there[rows, axis] = np.interp(fraction, at, other.force[others, axis])
            off[rows, axis] = np.interp(fraction, at, other.spread[others, axis])
    if not np.isfinite(there).any():
        raise LearningError(
            f"{source.name}: found no press that both sensors of the pair have; allowed: one or "
            "more to label"
        )
    ratio = np.empty(shape)
    ratio[:, 2] = _ratio(np.abs(there[:, 2]), np.abs(own.force[:, 2]), np.ones(len(source)))
    shear = np.linalg.norm(there[:, :2], axis=1), np.linalg.norm(own.force[:, :2], axis=1)
    ratio[:, :2] = _ratio(*shear, ratio[:, 2])[:, None]
    force = there + ratio * (source.table["wrench"][:, :3] - own.force)
    return Simulated(
        force, np.hypot(off, ratio * own.spread), f"{own.made_from}; {other.made_from}"
    )


def simulated_r2(
    archive: MarkerArchive, source: str, target: str, split: Path | None = None
) -> float | None:
    """Return R2 of simulated labels as predictions of the target's own, mean over axes.

    At paired locations, of the training presses of a split or of all seen indenters. None if a
    sensor has no forces of a twin, or the target no labels there.
    """
    one, other = archive[source], archive[target]
    if one.simulated is None or other.simulated is None:
        return None
    pairs = location_pairs(one.table, other.table)
    training = training_mask(archive, one, pairs.source, split)
    labels = simulated_labels(one, other).force[pairs.source[training]]
    true = other.table["wrench"][pairs.target[training], :3]
    return label_r2(true, labels)


def twin_forces(sensor: ArchivedSensor) -> Simulated:
    """Return the forces of a sensor's twin."""
    if sensor.simulated is None:
        raise LearningError(
            f"{sensor.name}: found no forces of a twin; allowed: tactile sim labels ARCHIVE "
            f"--sensor {sensor.name} --twin twin.yaml"
        )
    return sensor.simulated


def _groups(sensor: ArchivedSensor) -> dict[tuple[int, int], tuple[NDArray[np.int64], Floats]]:
    """Return rows and fraction of the phase of the frames of each location and phase."""
    return {
        (location, phase): (rows, np.arange(1, len(rows) + 1) / len(rows))
        for (location, phase), rows in press_rows(sensor.table, "phase").items()
    }


def _ratio(there: Floats, here: Floats, otherwise: Floats) -> Floats:
    """Return limited ratios (n,) of forces; `otherwise` where the source has hardly any."""
    measurable = here > LEAST_FORCE
    ratio: Floats = np.clip(there / np.where(measurable, here, 1.0), *RATIOS)
    return np.where(measurable, ratio, otherwise)
