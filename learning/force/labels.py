"""Labels that a force model learns from: an archive's, typed readings, a twin's, compensated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.compensation import (
    CHOICE_OF_METHOD,
    SIMULATED,
    read_stored,
    simulated_labels,
    twin_forces,
)
from learning.data.labels import read_labels
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.training.checkpoint import weights_hash
from recorder import MarkerArchive
from recorder.archive import Simulated

# Function from forces (N, 3) N, depth (N,) m and phase (N,) to forces for the target's material and
# the number of limited ones: `learning.compensation` with its sensors and parameters bound.
Compensation = Callable[
    [NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]],
    tuple[NDArray[np.float64], int],
]
# Other labels than the source's own.
Relabelling = Simulated | Compensation
# Spread of a label, as a fraction of the force range, at which it weighs half.
HALF = 0.05


def labels_of(presses: Presses, compensation: Relabelling | None = None) -> Tensor:
    """Return the training labels (N, 3) N of presses, on their device; NaN is no label."""
    presses.require_wrench()
    if compensation is None:
        return presses.wrench[:, :3]
    if isinstance(compensation, Simulated):
        known = torch.from_numpy(compensation.force[presses.rows.numpy()]).float()
        if not known.isfinite().any():
            raise LearningError(
                f"{presses.sensor}: found no press that both sensors of the pair have; allowed: "
                "one or more to label"
            )
        return known.to(presses.device)
    forces = presses.wrench[:, :3].double().cpu().numpy()
    changed, _ = compensation(forces, presses.depth.cpu().numpy(), presses.phase.cpu().numpy())
    if changed.shape != forces.shape or (np.isfinite(changed) != np.isfinite(forces)).any():
        raise LearningError(
            f"compensation of {presses.sensor}: found forces {changed.shape} that are not finite "
            f"where the labels are; allowed: {forces.shape}, finite"
        )
    return torch.from_numpy(changed).float().to(presses.device)


def variances_of(presses: Presses, compensation: Relabelling | None = None) -> Tensor | None:
    """Return the variance of each training label (N, 3) N^2; None if all are equally certain."""
    if not isinstance(compensation, Simulated):
        return None
    spread = torch.from_numpy(compensation.spread[presses.rows.numpy()]).float()
    return spread.nan_to_num().square().to(presses.device)


def weights_of(variance: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return weights of labels (..., 3), 1 if certain, for forces in the range low to high (3,)."""
    return 1 / (1 + variance / (HALF * (high - low)).square())


# Labels of a training that are not the archive's, as its command names them.

TWIN = "twin"
_ARCHIVE = ".markers.zarr"


@dataclass(frozen=True, slots=True)
class LabelSource:
    """Labels of a training."""

    wrench: Tensor | None = None
    """Forces in place of the archive's, for all rows of the sensor (n, 3) [N]; None: its own."""
    relabelling: Relabelling | None = None
    """Change of these labels; None: none."""
    data: tuple[str, ...] = ()
    """Words that identify what they are made of."""
    method: str = "transferred"
    """Method of a model that learns them from translated frames, one of `METHODS`."""
    own_twin: bool = False
    """True if they are the forces of the sensor's own twin."""

    def given_to(self, presses: Presses) -> Presses:
        """Return presses with these forces in place of the archive's."""
        if self.wrench is None:
            return presses
        return replace(presses, wrench=self.wrench[presses.rows].to(presses.wrench.device))


def label_source(
    name: str | None, archive: MarkerArchive, sensors: Sequence[str], pair: str | None = None
) -> LabelSource:
    """Return the labels of a training by their name.

    Args:
        name: A CSV of readings, `twin`, the archive of the target of a pair with forces of its
            twin, or FILE.json or FILE.json:CHOICE of `tactile compensate`; None: the archive's
            labels.
        archive: Archive of the training.
        sensors: Sensors that are trained on.
        pair: A-to-B, labels of A for B; None: as the name of the only sensor says.
    """
    if name is None:
        if pair is not None:
            raise LearningError("--pair: found without --labels; allowed: both")
        return LabelSource()
    if len(sensors) > 1 and (pair is None or ".json" not in name):
        raise LearningError(
            f"--sensor: found {', '.join(sensors)}; allowed with --labels {name}: one, whose they "
            "are"
        )
    source, to, target = (pair or sensors[0]).partition("-to-")
    if name.endswith(".csv"):
        read = read_labels(Path(name), archive, sensors[0]).of_all(len(archive[sensors[0]]))
        forces = torch.from_numpy(read.astype(np.float32))
        return LabelSource(forces, data=(weights_hash(Path(name)),))
    if name == TWIN and not to:
        labels = twin_forces(archive[sensors[0]])
        forces = torch.from_numpy(labels.force).float()
        return LabelSource(forces, labels, (labels.made_from,), own_twin=True)
    if not to:
        raise LearningError(
            f"--pair: found {pair or ','.join(sensors)}; allowed with --labels {name}: A-to-B"
        )
    if name == TWIN or name.rstrip("/").endswith(_ARCHIVE):
        other = archive if name == TWIN else MarkerArchive(name)
        if target not in other:
            raise LearningError(
                f"{other.name}: has no sensor {target!r}; allowed: --labels Y.markers.zarr, which "
                f"holds {target} with forces of its twin"
            )
        labels = simulated_labels(archive[sensors[0]], other[target])
        return LabelSource(relabelling=labels, data=(labels.made_from,), method=SIMULATED)
    file, _, choice = name.partition(":")
    stored = read_stored(Path(file)).pair(source, target, choice or CHOICE_OF_METHOD["compensated"])
    return LabelSource(
        relabelling=stored.applied,
        data=(weights_hash(Path(file)), f"{source}-to-{target}", choice),
        method=next(each for each, known in CHOICE_OF_METHOD.items() if known == (choice or known)),
    )
