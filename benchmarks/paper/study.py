"""Archives, presses by role and stored results, which `paper` and `gauge` have in common.

A run has a folder. Archives and networks there are read, not made again, and so are the values of
jobs that are done: the same command goes on after Ctrl-C.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report import ROOT, Run
from learning.compensation.fit import PairCompensation, StoredCompensation, find_compensation
from learning.data.images import shrink
from learning.data.presses import Presses, load_presses, read_frames
from learning.data.splits import Role, Split
from learning.errors import LearningError
from learning.force.train import ForceModelSettings, ForceStageSettings
from recorder import MarkerArchive
from recorder.archive import location_pairs
from recorder.store import replace_file
from sim.dataset import DatasetPlan, begin, fill
from sim.dataset.run import make_here, make_in_processes
from sim.device import ready_device

Floats = NDArray[np.float64]
UNSEEN: Role = "new_indenter"
# Side of the images that the nearest frame is searched in.
SMALL = 64
# Presses that a GPU solves in one launch.
AT_ONCE = 162


def folder_of(run: Run, name: str) -> Path:
    """Return the folder of a part's archives and networks, where a repeated command goes on."""
    if run.options.work is None and run.quick:
        return run.folder
    work: Path = run.options.work or ROOT / "build" / "benchmarks"
    folder = work / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def simulate(
    path: Path, plan: DatasetPlan, device: str, processes: int, progress: Callable[[float], None]
) -> MarkerArchive:
    """Make or complete an archive, and return it."""
    ready_device(device)
    if device != "cpu":
        solving = replace(plan.solving, one_topology=plan.solving.tier == "fem")
        plan = replace(plan, batch_size=AT_ONCE, solving=solving)
    opened = begin(path, plan, device)
    make = make_in_processes if device == "cpu" else make_here
    fill(opened, partial(make, opened, device=device, processes=processes), progress)
    return MarkerArchive(path)


class Joined(MarkerArchive):
    """Archives of single sensors as one, with locations in common."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Open the archives.

        Raises:
            LearningError: They have other indenters.
            SessionError: One is not an archive.
        """
        super().__init__(paths[0])
        for path in paths[1:]:
            other = MarkerArchive(path)
            if other.indenters != self.indenters:
                raise LearningError(f"{path}: indenters differ from those of {paths[0]}")
            self._sensors |= dict(other.items())


@dataclass(frozen=True, eq=False)
class Study:
    """Frames of simulated sensors, with the roles of their presses."""

    folder: Path
    archive: MarkerArchive
    split: Split
    device: torch.device
    processes: int
    """Processes that track markers."""
    skins_differ: bool
    """True if labels that are carried over are compensated by force-depth curves."""

    @cached_property
    def compensation(self) -> StoredCompensation | None:
        """Compensation of labels between skins; None: all skins are alike."""
        return find_compensation(self.archive)[0] if self.skins_differ else None

    @cached_property
    def _unseen(self) -> dict[tuple[str, str], Presses]:
        return {}

    def relabelling(self, source: str, target: str) -> PairCompensation | None:
        """Return what compensates a source's labels for a target; None: nothing does.

        A simulated force-depth press that has no solution leaves a pair without.
        """
        pairs = () if self.compensation is None else self.compensation.pairs
        if self.compensation is None or all(
            (each.source, each.target) != (source, target) for each in pairs
        ):
            return None
        return self.compensation.pair(source, target, "priors")

    def model(self, name: str) -> Path:
        """Folder of a trained network."""
        return self.folder / "models" / name

    def presses(self, sensor: str, role: Role, form: Any = "images") -> Presses:
        """Presses of a sensor that have a role."""
        one = self.archive[sensor]
        how: dict[str, Any] = {"device": self.device, "processes": self.processes}
        return load_presses(one, self.split.rows(one.table, role), form=form, **how)

    def unseen(self, sensor: str, form: Any = "images") -> Presses:
        """Presses of a sensor under indenters that nothing was trained on."""
        if (sensor, form) not in self._unseen:
            self._unseen[sensor, form] = self.presses(sensor, UNSEEN, form)
        return self._unseen[sensor, form]

    def true_forces(self, sensor: str) -> tuple[Floats, NDArray[np.str_]]:
        """Fx, Fy, Fz (n, 3) [N] of those presses' frames, and the names of their indenters (n,)."""
        rows, table = self.unseen(sensor).rows.numpy(), self.archive[sensor].table
        names = np.array(self.archive.indenters)[table["indenter"][rows]]
        return table["wrench"][rows, :3].astype(np.float64), names

    @property
    def launch(self) -> str:
        """Override of settings that names the device."""
        return f"launch.device={self.device.type}"


def once(folder: Path, name: str, measure: Callable[[], Any]) -> Any:
    """Return the values of a job, as JSON has them; they are computed once in a folder."""
    path = folder / "measured" / f"{name.replace(' ', '-')}.json"
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        replace_file(path, json.dumps(measure()).encode())
    return json.loads(path.read_text(encoding="utf-8"))


def form_of(preset: str) -> Any:
    """Return the form of presses that a net reads."""
    return "field" if preset in ("displacement", "superposed") else "images"


def shortened(
    stage: ForceStageSettings, epochs: int, presses: int, settings: ForceModelSettings
) -> ForceStageSettings:
    """Return a stage of another number of epochs."""
    steps = epochs * -(-presses // settings.sequences.batch)
    return replace(stage, epochs=epochs, warm_up_steps=min(stage.warm_up_steps, steps // 10))


def nearest_labels(study: Study, source: str, target: str) -> Floats:
    """Return for each test frame the source's label of the most similar location pair.

    The pairs are those that the translators are trained on: the target's images, the source's
    labels. Similar is by mean square of the images' change from no contact.
    """
    one, other = study.archive[source], study.archive[target]
    pairs = location_pairs(one.table, other.table)
    trained = np.isin(pairs.target, study.split.rows(other.table, "train"))
    rows = pairs.source[trained]
    labels = one.table["wrench"][rows, :3].astype(np.float64)
    compensation = study.relabelling(source, target)
    if compensation is not None:
        depth, phase = one.table["depth"][rows], one.table["phase"][rows]
        labels, _ = compensation.applied(labels, depth.astype(np.float64), phase.astype(np.int64))

    def changes(rows: NDArray[np.int64]) -> torch.Tensor:
        images = read_frames(other, rows, study.device).float()
        still = torch.from_numpy(shrink(other.references)).to(study.device).float()
        of = torch.from_numpy(other.table["reference"][rows].astype(np.int64)).to(study.device)
        change = (images - still[of])[:, None]
        return torch.nn.functional.interpolate(change, (SMALL, SMALL), mode="area").flatten(1)

    apart = torch.cdist(changes(study.unseen(target).rows.numpy()), changes(pairs.target[trained]))
    return np.asarray(labels[apart.argmin(dim=1).cpu().numpy()], np.float64)
