"""Second stage: the model learns the target's own frames, with the source's labels at their place.

Frames that a translator made differ from the target's own. Where a press of the source matches one
of the target, its labels belong to the target's frames too, scaled between the skins.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from learning.archive_writer import archive_fingerprint
from learning.data.presses import load_presses
from learning.data.splits import Split
from learning.experiment.settings import ExperimentSettings
from learning.experiment.stages import force_settings
from learning.force.labels import Relabelling
from learning.force.model import KIND, load_force_model
from learning.force.train import train_force
from learning.training.run import RunFolder, session_of
from learning.transfer.calibrate import wanted_forces
from recorder import MarkerArchive


def tune_by_place(
    archive: MarkerArchive,
    source: str,
    target: str,
    split: Split,
    trained: Path,
    settings: ExperimentSettings,
    compensation: Relabelling | None,
    device: str,
    name: str = "by place",
) -> Path:
    """Fine-tune a model on the target's training presses that match; return its folder.

    Args:
        archive: Presses of both sensors.
        source: Sensor with labels.
        target: Sensor of the frames.
        split: Roles of presses.
        trained: Folder of the model that was trained on translated frames.
        settings: Settings of the experiment, whose fine-tuning is repeated.
        compensation: Scaling of the labels.
        device: Device of the training.
        name: Name of this training, which ends that of its folder.

    Returns:
        Folder of the model; `trained` itself if no training press matches.
    """
    sensor = archive[target]
    rows = split.rows(sensor.table, "train")
    wanted = wanted_forces(archive, source, target, compensation)
    location = sensor.table["location"][rows]
    matched = np.unique(location[np.isfinite(wanted[rows]).any(axis=1)])
    rows = rows[np.isin(location, matched)]
    if not len(rows):
        return trained
    tuning = force_settings(settings, archive, device, tuning=True)
    data = f"{archive_fingerprint(archive)} {split.fingerprint} {target} {name}"
    if compensation is not None and compensation.made_from:
        data += f" {compensation.made_from}"
    folder = trained.with_name(f"{trained.name}.{name.replace(' ', '-')}")
    with RunFolder.open(folder, KIND, tuning, data, True, keep=1) as run:
        if not run.finished:
            presses = load_presses(sensor, rows, device=device)
            labels = torch.from_numpy(wanted[presses.rows.numpy()]).float()
            presses = replace(presses, wrench=labels.to(presses.device))
            before = load_force_model(trained, device)
            with session_of(run, tuning.launch, f"steps of {target} by place") as session:
                train_force(presses, tuning, session, start_from=before)
    return folder
