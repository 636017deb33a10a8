"""Next stages: a model of the target learns its own frames, and its errors become intervals.

Frames that a translator made differ from the target's own. Where a press of the source matches one
of the target, its labels, scaled between the skins, belong to the target's frames too. The model
learns these, and on indenters that it has not seen yet they are what its forces are compared with.
So an interval contains the errors of the translation and of the model on a new indenter, not an
error of that scaling: that one is the interval's `Scale`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from learning.data.presses import load_presses
from learning.data.splits import Split
from learning.experiment.settings import ExperimentSettings
from learning.experiment.stages import force_settings
from learning.force.calibrate import (
    ExpectedForces,
    IntervalCalibration,
    calibrated,
    presses_of_rows,
)
from learning.force.intervals import Scale
from learning.force.labels import Relabelling
from learning.force.loading import load_force_model
from learning.force.model import KIND, ForceModel
from learning.force.train import train_force
from learning.training.run import RunFolder, session_of
from learning.transfer.pairs import labels_by_place
from recorder.archive import ArchivedSensor, MarkerArchive, archive_fingerprint

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ByPlace:
    """Two sensors whose presses match by place."""

    archive: MarkerArchive
    """Presses of both."""
    source: str
    """Sensor with labels."""
    target: str
    """Sensor of the frames."""
    relabelling: Relabelling | None
    """Scaling of the labels between the skins."""

    @cached_property
    def labels(self) -> Floats:
        """Scaled labels of the source (m, 3) [N]; NaN where a frame may not be learned from."""
        table = self.archive[self.source].table
        labels = np.full((len(table["location"]), 3), np.nan)
        rows = np.flatnonzero(table["valid"] & (table["location"] >= 0) & table["seen"])
        own = np.asarray(table["wrench"][rows, :3], np.float64)
        if self.relabelling is not None:
            depth, phase = table["depth"][rows], table["phase"][rows].astype(np.int64)
            own = self.relabelling.forces(rows, own, np.asarray(depth, np.float64), phase)
        labels[rows] = own
        return labels

    @cached_property
    def expected(self) -> Floats:
        """These labels at the target's frames (n, 3) [N]; NaN without one."""
        source, target = (self.archive[name].table for name in (self.source, self.target))
        return labels_by_place(source, self.labels, target)

    def calibrate(
        self, model: ForceModel, indenters: Sequence[str], scale: Scale
    ) -> IntervalCalibration:
        """Return the intervals of a model of the target, given its known scale.

        Indenters that calibrate are seen in the archive, never by the model.
        """
        table = self.archive[self.target].table
        calibrates = np.isin(np.array(self.archive.indenters)[table["indenter"]], indenters)
        text = f"{self.source}'s labels at the same place, scaled between the skins"
        expected = ExpectedForces(self.expected, text, scale, self.labels)
        learned = table["seen"] & ~calibrates
        return calibrated(
            self.archive, self.target, model, expected, calibrates=calibrates, learned=learned
        )

    def tune(
        self, trained: Path, split: Split, settings: ExperimentSettings, device: str, name: str
    ) -> Path:
        """Fine-tune a model on the target's training presses that match; return its folder.

        Without such a press that is the model's own; else it ends with the name of this training.
        The fine-tuning of the experiment's settings is repeated.
        """
        sensor = self.archive[self.target]
        rows = split.rows(sensor.table, "train")
        location = sensor.table["location"][rows]
        matched = np.unique(location[np.isfinite(self.expected[rows]).any(axis=1)])
        rows = rows[np.isin(location, matched)]
        if not len(rows):
            return trained
        tuning = force_settings(settings, device, tuning=True)
        data = f"{archive_fingerprint(self.archive)} {split.fingerprint} {self.target} {name}"
        if self.relabelling is not None:
            data = f"{data} {self.relabelling.made_from}".rstrip()
        folder = trained.with_name(f"{trained.name}.{name.replace(' ', '-')}")
        run = RunFolder.open(folder, KIND, tuning, data)
        if not run.finished:
            presses = load_presses(sensor, rows, device=device)
            labels = torch.from_numpy(self.expected[presses.rows.numpy()]).float()
            presses = replace(presses, wrench=labels.to(presses.device))
            before = load_force_model(trained, device)
            with session_of(run, tuning.launch, f"steps of {self.target} by place") as session:
                train_force(presses, tuning, session, start_from=before)
        return folder


def forces_at(
    sensor: ArchivedSensor, rows: Sequence[int] | NDArray[np.int64], model: ForceModel
) -> Floats:
    """Return the forces that a model predicts in some rows (n, 3) [N], from their whole presses."""
    table = sensor.table
    keys = np.stack([table[name] for name in ("location", "indenter", "target")], axis=1)
    pressed = np.unique(keys[rows], axis=0)
    whole = (keys[:, None] == pressed[None]).all(axis=-1).any(axis=1) & table["valid"]
    presses = presses_of_rows(sensor, np.flatnonzero(whole), model)
    order = {row: index for index, row in enumerate(presses.rows.tolist())}
    return model.predict(presses)[[order[int(row)] for row in rows]]
