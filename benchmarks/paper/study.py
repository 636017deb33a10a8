"""Shared by `paper` and `gauge`: archives, presses by role, and trainings in memory."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report import ROOT, Run
from learning.compensation.fit import StoredCompensation, find_compensation
from learning.config import read_settings
from learning.data.images import shrink
from learning.data.presses import Presses, load_presses, read_frames
from learning.data.splits import Role, Split
from learning.errors import LearningError
from learning.experiment.frames import look_of, translate_presses
from learning.force.labels import Relabelling, compensated
from learning.force.model import ForceModel
from learning.force.train import PRESETS, ForceModelSettings, ForceStageSettings, train_force
from learning.training.run import TrainingSession, accelerator
from learning.translation.field import train as field_training
from learning.translation.field.data import gather_role
from learning.translation.field.network import FieldModel
from learning.translation.field.translator import FieldTranslator
from learning.translation.translator import SensorView, Translator, for_pair
from recorder import MarkerArchive
from recorder.archive import location_pairs
from recorder.processes import cores
from sim.dataset import DatasetPlan, begin, fill
from sim.dataset.run import make_here, make_in_processes
from sim.device import ready_device
from sim.sensors import SimulatedSensor

Floats = NDArray[np.float64]
Result = TypeVar("Result")
Train = Callable[[int, TrainingSession], Result]
UNSEEN: Role = "new_indenter"
# Side of the images that the nearest frame is searched in.
SMALL = 64
# Presses that a GPU solves in one launch.
AT_ONCE = 162
# Steps, and epochs, that are timed before a training, until they take some time [s].
PROBE, PROBED_EPOCHS, ENOUGH_S = 12, 1, 1.5
# Steps, and epochs, of a training that has no time.
FEW = 2
# Preset and overrides of the field translator, of a complete run and of a quick one.
FIELD = (
    ("ours", "field_stage.batch=96", "map_stage.batch=96"),
    ("cpu_smoke", "field_stage.batch=1", "map_stage.batch=1", "examples.patterns=2"),
)
# SGD of 0.1 leaves its start too late for these trainings: from the mean label, without dropout.
PAPER_RECIPE = (
    "optimiser={name: adamw, weight_decay: 0.01, clip: 1.0}",
    "stages=[{epochs: 40, learning_rate: 0.0003, schedule: cosine, warm_up_steps: 200}]",
    "sequences={batch: 16, lengths: random, padding: masked}",
    "launch.mixed_precision=bf16",
    "start_at_mean=true",
    "range_margin=0.05",
    "network.dropout=0",
)


def folder_of(run: Run, name: str) -> Path:
    """Return the folder of a part's archives, where an interrupted simulation goes on."""
    if run.quick:
        return run.folder
    folder = ROOT / "build" / "benchmarks" / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def simulate(
    path: Path, plan: DatasetPlan, run: Run, progress: Callable[[float], None], device: str = ""
) -> MarkerArchive:
    """Make or complete an archive, on the run's device or another, and return it."""
    device = device or run.device
    make = make_in_processes if device == "cpu" and not run.quick else make_here
    return made(path, plan, device, partial(make, processes=processes(run)), progress)


def made(
    path: Path,
    plan: DatasetPlan,
    device: str,
    make: Callable[..., Any] = make_here,
    progress: Callable[[float], None] = lambda done: None,
) -> MarkerArchive:
    """Make or complete an archive on a device by one of the makers of `sim.dataset`."""
    ready_device(device)
    if device != "cpu":
        solving = replace(plan.solving, one_topology=plan.solving.tier == "fem")
        plan = replace(plan, batch_size=AT_ONCE, solving=solving)
    opened = begin(path, plan, device)
    fill(opened, partial(make, opened, device=device), progress)
    return MarkerArchive(path)


def quick_row(row: SimulatedSensor) -> SimulatedSensor:
    """Return a sensor with one force-depth press and, as nothing drifts, one still image."""
    assert row.force_depth is not None
    once, variation = replace(row.force_depth, repeats=1), replace(row.variation, drift=None)
    return replace(row, force_depth=once, variation=variation)


def processes(run: Run) -> int:
    """Return the number of processes; a quick run spends more on their start than they save."""
    return 1 if run.quick else cores()


class Joined(MarkerArchive):
    """Archives of single sensors, under the same indenters, as one with locations in common."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Open the archives."""
        super().__init__(paths[0])
        for path in paths[1:]:
            self._sensors |= dict(MarkerArchive(path).items())


@dataclass(frozen=True, eq=False)
class Study:
    """Frames of simulated sensors, with the roles of their presses."""

    archive: MarkerArchive
    split: Split
    device: torch.device
    skins_differ: bool = True
    """True if labels that are carried over are compensated by force-depth curves."""
    quick: bool = False
    seed: int = 0
    """Seed of the trainings."""
    field_seconds: float = 0
    """Training time of the field translator [s]; 0: a few steps."""
    _unseen: dict[tuple[str, str], Presses] = field(default_factory=dict)

    @cached_property
    def compensation(self) -> StoredCompensation | None:
        """Compensation of labels between skins; None: all skins are alike."""
        return find_compensation(self.archive)[0] if self.skins_differ else None

    def curves(self, source: str, target: str) -> Relabelling | None:
        """Return a source's labels compensated for a target by force-depth curves; None: its own.

        A simulated force-depth press that has no solution leaves a pair without.
        """
        stored = self.compensation
        if stored is None or (source, target) not in {(p.source, p.target) for p in stored.pairs}:
            return None
        return compensated(stored.pair(source, target, "priors"))

    def presses(self, sensor: str, role: Role, form: Any = "images") -> Presses:
        """Presses of a sensor that have a role."""
        one = self.archive[sensor]
        how: dict[str, Any] = {"device": self.device, "processes": max(1, cores() // 2)}
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

    def translated(self, translator: Translator, packed: Presses, target: str) -> Presses:
        """Return packed presses of a source as images of a target."""
        ends = (SensorView.of(self.archive[name]) for name in (packed.sensor, target))
        look = look_of(self.archive[target], packed, self.device)
        return translate_presses(packed, look, for_pair(translator, *ends))

    @cached_property
    def field(self) -> FieldTranslator:
        """The field translator between sensors, trained without a simulator's displacement."""
        sensors = self.split.trained_sensors(self.archive)
        frames = gather_role(self.archive, self.split, sensors, "train", device=self.device)
        if frames is None:
            raise LearningError(f"{self.archive.name}: no press to train on; allowed: some")
        without = replace(frames, shift=None)
        preset, *batches = FIELD[self.quick]

        def settings(steps: int) -> field_training.FieldSettings:
            half = [f"{stage}.steps={max(1, steps // 2)}" for stage in ("field_stage", "map_stage")]
            own = [f"seed={self.seed}", f"validate_every_steps={steps}", self.launch]
            overrides = [*batches, *half, *own]
            presets = field_training.PRESETS
            return read_settings(field_training.FieldSettings, presets, preset, overrides)

        def train(steps: int, session: TrainingSession) -> FieldModel:
            return field_training.train_field(without, settings(steps), None, session)

        return FieldTranslator("field", timed(self.field_seconds, settings(PROBE).launch, train))

    @property
    def launch(self) -> str:
        """Override of settings that names the device."""
        return f"launch.device={self.device.type}"


def timed(seconds: float, launch: Any, train: Train[Result], probe: int = PROBE) -> Result:
    """Return what `train` returns for as many steps, or epochs, as fit in a time; 0: for a few.

    `probe` is the number that is timed at first.
    """
    steps = max(2, int(seconds / _seconds_of_one(probe, launch, train))) if seconds else FEW
    return train(steps, TrainingSession(accelerator(launch)))


def _seconds_of_one(units: int, launch: Any, train: Train[Result]) -> float:
    """Return the time of one step, or of one epoch, of a training that is timed."""
    while True:
        stamps: dict[int, float] = {}

        def stamp(done: int, _: int, stamps: dict[int, float] = stamps) -> None:
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            stamps[done] = time.perf_counter()

        train(units, TrainingSession(accelerator(launch), progress=stamp))
        if len(stamps) >= 4:
            # Medians of both halves: a start, or work between two stages, is no step.
            halves = np.array_split(np.diff(list(stamps.values())), 2)
            seconds = float(np.mean([np.median(each) for each in halves])) * len(stamps)
            if seconds > ENOUGH_S:
                return seconds / units
        units *= 4


def form_of(preset: str) -> Any:
    """Return the form of presses that a net reads."""
    return "field" if preset == "displacement" else "images"


def net_settings(study: Study, preset: str, overrides: Sequence[str]) -> ForceModelSettings:
    """Return the settings of a force net whose number of epochs does not depend on its scores."""
    own = [f"seed={study.seed}", "patience_epochs=null", study.launch, *overrides]
    if study.device.type == "cpu":
        own.append("launch.mixed_precision=no")
    return read_settings(ForceModelSettings, PRESETS, preset, own)


def train_net(
    presses: Presses,
    settings: ForceModelSettings,
    stages: Sequence[ForceStageSettings],
    epochs: int,
    start_from: ForceModel | None = None,
    labels: Relabelling | None = None,
    session: TrainingSession | None = None,
) -> ForceModel:
    """Return a force net that is trained in some stages, each of a number of epochs.

    It learns the presses' own labels, or others.
    """
    steps = epochs * -(-len(presses) // settings.sequences.batch)
    short = tuple(
        replace(stage, epochs=epochs, warm_up_steps=min(stage.warm_up_steps, steps // 10))
        for stage in stages
    )
    learned = presses if labels is None else labels.of(presses)
    return train_force(learned, replace(settings, stages=short), session, start_from=start_from)


def nearest_labels(study: Study, source: str, target: str) -> Floats:
    """Return for each test frame the source's label of the most similar location pair.

    The pairs are those that the translators are trained on: the target's images, the source's
    labels. Similar is by mean square of the images' change from no contact.
    """
    one, other = study.archive[source], study.archive[target]
    pairs = location_pairs(one.table, other.table)
    trained = np.isin(pairs.target, study.split.rows(other.table, "train"))
    rows = pairs.source[trained]
    labels = forces_by_curves(study, source, target, rows)

    def changes(rows: NDArray[np.int64]) -> torch.Tensor:
        images = read_frames(other, rows, study.device).float()
        still = torch.from_numpy(shrink(other.references)).to(study.device).float()
        of = torch.from_numpy(other.table["reference"][rows].astype(np.int64)).to(study.device)
        change = (images - still[of])[:, None]
        return torch.nn.functional.interpolate(change, (SMALL, SMALL), mode="area").flatten(1)

    apart = torch.cdist(changes(study.unseen(target).rows.numpy()), changes(pairs.target[trained]))
    return np.asarray(labels[apart.argmin(dim=1).cpu().numpy()], np.float64)


def forces_by_curves(study: Study, source: str, target: str, rows: NDArray[np.int64]) -> Floats:
    """Return the source's forces (n, 3) [N] in some of its rows, compensated for the target."""
    table, curves = study.archive[source].table, study.curves(source, target)
    forces = table["wrench"][rows, :3].astype(np.float64)
    if curves is None:
        return forces
    depth, phase = table["depth"][rows], table["phase"][rows]
    return curves.forces(rows, forces, depth.astype(np.float64), phase.astype(np.int64))
