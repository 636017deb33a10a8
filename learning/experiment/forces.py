"""Force models of an experiment: trained per source, transferred to targets, and evaluated."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import torch

from learning.archive_writer import archive_fingerprint
from learning.compensation import (
    CHOICE_OF_METHOD,
    SIMULATED,
    StoredCompensation,
    simulated_labels,
)
from learning.config import read_settings
from learning.data.presses import Presses
from learning.data.splits import Split
from learning.errors import LearningError
from learning.evaluation.predictions import (
    Predictions,
    predictions_of,
    read_predictions,
)
from learning.experiment.models import Places, Tuning, tune_batched
from learning.experiment.parts import (
    Pair,
    Tested,
    as_images,
    frames_of_a_press,
    look_of,
    tested_on,
    trained_on,
)
from learning.experiment.settings import ExperimentSettings
from learning.experiment.translating import flow_fields, translate_presses, warp_presses
from learning.force.labels import Relabelling
from learning.force.model import KIND, ForceModel, load_force_model
from learning.force.train import PRESETS, ForceSettings, train_force
from learning.metrics import force_errors
from learning.training.checkpoint import read_model_folder
from learning.training.run import RunFolder, Session, Stop, accelerator
from learning.translation.archive import Model
from learning.translation.translator import FLOW, SensorView, for_pair
from recorder import MarkerArchive
from recorder.archive import Simulated
from recorder.progress import ItemProgress

# Training settings of the force models of an experiment.


def force_settings(
    experiment: ExperimentSettings,
    archive: MarkerArchive,
    device: torch.device,
    *,
    tuning: bool = False,
) -> ForceSettings:
    """Return the settings of force models.

    Args:
        experiment: Names a preset and its overrides.
        archive: Archive of the training data.
        device: Device of the training.
        tuning: True for fine-tuning of the source's model on translated frames.
    """
    changed = experiment.overrides(
        *experiment.force.set,
        *(experiment.fine_tuning if tuning else ()),
        f"launch.device={device.type}",
    )
    try:
        settings = read_settings(ForceSettings, PRESETS, experiment.force.preset, changed)
    except LearningError as error:
        raise LearningError(f"{'fine_tuning' if tuning else 'force'}: {error}") from None
    if settings.input.stored_form != "images":
        raise LearningError(
            f"force: found {experiment.force.preset}, which sees marker fields; allowed: a model "
            "that sees images, which is what is translated"
        )
    if experiment.memory:
        return settings
    # A step has as many frames as with whole presses.
    batch = settings.sequences.batch * frames_of_a_press(archive)
    return replace(settings, sequences=replace(settings.sequences, batch=batch))


BEFORE, TRANSFERRED, TARGET = "source-only", "transferred", "target"


@dataclass(slots=True, eq=False)
class Forces:
    """Trains and predicts for one archive. Existing results are read, not computed again."""

    archive: MarkerArchive
    split: Split
    settings: ExperimentSettings
    places: Places
    device: torch.device
    processes: int
    """Number of processes that track markers."""
    say: Callable[[str], None]
    unlabelled: frozenset[str] = frozenset()
    """Targets without labels in training presses."""
    _tested: dict[str, Tested] = field(default_factory=dict)
    _seen: dict[str, tuple[Presses, Presses | None]] = field(default_factory=dict)
    _own: dict[str, tuple[Path, ForceModel]] = field(default_factory=dict)
    _data: str = ""

    def own(self, sensor: str) -> Predictions:
        """Return predictions on a sensor by the model that was trained on its own labels."""
        return self._predicted(Pair(sensor, sensor), TARGET)

    def adopt(self, sensor: str, model: ForceModel) -> None:
        """Store a model as that of a sensor, in place of training one."""
        name = f"force-{sensor}"
        with self._open(name, self._settings(), sensor) as run:
            if not run.finished:
                run.finish(0, {"model": model})
                return
        own = load_force_model(self.places.model(name)).state_dict()
        same = all(torch.equal(own[key], each) for key, each in model.state_dict().items())
        if not same:
            raise LearningError(
                f"{self.places.model(name)}: found another model of {sensor}; allowed: the same, "
                "or another folder"
            )

    def untranslated(self, pair: Pair) -> Predictions:
        """Return predictions on the target by the source's model."""
        return self._predicted(pair, BEFORE)

    def translated(
        self,
        pairs: Sequence[Pair],
        translator: str,
        model: Model,
        compensation: StoredCompensation | None,
    ) -> list[Predictions]:
        """Return predictions by models fine-tuned on translated frames, for each kind of labels.

        Args:
            pairs: Pairs of one source.
            translator: Name of the translator.
            model: The translator.
            compensation: Relabelling of labels; None if the settings request none.
        """
        # Targets of the same scale share the fields computed from the source's frames.
        known: dict[tuple[float, float], torch.Tensor] = {}
        at_once = max(1, self.settings.models_per_batch // (1 + len(self.settings.compensation)))
        found = []
        for first in range(0, len(pairs), at_once):
            tunings = [
                Tuning(
                    pair, method, translator, relabelling(self.archive, pair, method, compensation)
                )
                for pair in pairs[first : first + at_once]
                for method in (TRANSFERRED, *self._compensated(pair, compensation))
            ]
            due = [each for each in tunings if not self._file_of(each).exists()]
            shown = {
                pair: self._translated(pair, model, known)
                for pair in dict.fromkeys(each.pair for each in due)
            }
            if due and self.settings.models_per_batch > 1:
                seen = {pair: self._as_seen(presses) for pair, presses in shown.items()}
                _, own = self._own_model(due[0].pair.source)
                tune_batched(due, seen, self._settings(tuning=True), own, self._run_of)
            for each in tunings:
                found.append(self._predicted(each.pair, each.method, each, shown.get(each.pair)))
        for pair in pairs:
            self._seen.pop(pair.source, None)
        return found

    def _compensated(self, pair: Pair, stored: StoredCompensation | None) -> list[str]:
        """Return the kinds of compensated labels; an unlabelled target may lack some or all."""
        asked: list[str] = list(self.settings.compensation)
        if pair.target not in self.unlabelled:
            return asked
        known = () if stored is None else stored.pairs
        choices = {
            choice
            for each in known
            if (each.source, each.target) == (pair.source, pair.target)
            for choice in each.choices
        }
        return [
            method for method in asked if method == SIMULATED or CHOICE_OF_METHOD[method] in choices
        ]

    def _predicted(
        self,
        pair: Pair,
        method: str,
        tuning: Tuning | None = None,
        shown: Presses | None = None,
    ) -> Predictions:
        translator = "" if tuning is None else tuning.translator
        file = self._file(pair, method, translator)
        if not file.exists():
            if tuning is None or shown is None:
                folder, model = self._own_model(pair.source)
            else:
                folder, model = self._tuned_model(tuning, shown)
            tested = self._tested_on(pair.target)
            predictions_of(
                self.archive[pair.target],
                self.archive.indenters,
                tested.presses.rows.numpy(),
                tested.role,
                model.predict(self._as_seen(tested.presses)),
                source=pair.source,
                method=method,
                translator=translator,
                model=read_model_folder(folder).hash(),
            ).write(file)
        found = read_predictions(file)
        by = f" by {translator}" if translator else ""
        scored = "no label to compare with"
        if found.is_scored:
            errors = force_errors(found.true, found.predicted, found.label_std)
            scored = f"R2{errors.of_axes} {errors.r2_mean:.3f}"
        self.say(f"{pair.source} to {pair.target}, {method}{by}: {scored}")
        return found

    def _own_model(self, sensor: str) -> tuple[Path, ForceModel]:
        """Return the model trained on a sensor's own frames and labels."""
        if sensor not in self._own:
            settings = self._settings()

            def frames() -> tuple[Presses, Presses | None]:
                packed, held = self._frames(sensor)
                return as_images(packed), None if held is None else as_images(held)

            self._own[sensor] = self._trained(f"force-{sensor}", settings, sensor, frames)
        return self._own[sensor]

    def _tuned_model(self, tuning: Tuning, shown: Presses) -> tuple[Path, ForceModel]:
        """Return the source's model after fine-tuning on translated frames."""
        _, own = self._own_model(tuning.pair.source)
        return self._trained(
            tuning.name,
            self._settings(tuning=True),
            _data(tuning, shown.sensor),
            lambda: (shown, None),
            start_from=own,
            compensation=tuning.labels,
        )

    def _trained(
        self,
        name: str,
        settings: ForceSettings,
        sensor: str,
        frames: Callable[[], tuple[Presses, Presses | None]],
        *,
        start_from: ForceModel | None = None,
        compensation: Relabelling | None = None,
    ) -> tuple[Path, ForceModel]:
        """Return a model and its folder; its training frames are loaded only if needed."""
        folder = self.places.model(name)
        with self._open(name, settings, sensor) as run:
            if not run.finished:
                presses, held = frames()
                validation = () if held is None else self._as_seen(held)
                with (
                    ItemProgress(f"steps of {name}", sys.stderr) as steps,
                    Stop(partial(print, file=sys.stderr)) as stop,
                ):
                    train_force(
                        self._as_seen(presses),
                        settings,
                        Session(accelerator(settings.launch), run, stop, steps),
                        validation=validation,
                        start_from=start_from,
                        compensation=compensation,
                    )
                if stop.asked and not run.finished:
                    raise KeyboardInterrupt
        return folder, load_force_model(folder, self.device)

    def _run_of(self, tuning: Tuning) -> RunFolder:
        shown = _data(tuning, f"{tuning.pair.source}-to-{tuning.pair.target}")
        return self._open(tuning.name, self._settings(tuning=True), shown)

    def _open(self, name: str, settings: ForceSettings, sensor: str) -> RunFolder:
        """Open the run folder of a model that is trained on a sensor's frames."""
        if not self._data:
            self._data = f"{archive_fingerprint(self.archive)} {self.split.fingerprint}"
        data = f"{self._data} {sensor}"
        return RunFolder.open(self.places.model(name), KIND, settings, data, True, keep=1)

    def _translated(
        self, pair: Pair, model: Model, known: dict[tuple[float, float], torch.Tensor]
    ) -> Presses:
        packed, _ = self._frames(pair.source)
        source, target = self.archive[pair.source], self.archive[pair.target]
        views = SensorView.of(source), SensorView.of(target)
        look = look_of(target, packed, self.device)
        name = f"frames of {pair.source} to {pair.target} by {model.name}"
        with ItemProgress(name, sys.stderr) as progress:
            if model.name != FLOW:
                translator = for_pair(model.translator, *views)
                return translate_presses(packed, look, translator, progress=progress)
            scale = (
                views[1].mm_per_column / views[0].mm_per_column,
                views[1].mm_per_row / views[0].mm_per_row,
            )
            if scale not in known:
                known[scale] = flow_fields(
                    packed, *views, processes=self.processes, progress=progress
                )
            return warp_presses(packed, look, known[scale], progress=progress)

    def _frames(self, sensor: str) -> tuple[Presses, Presses | None]:
        """Return a source's presses for training, packed, and those for validation."""
        if sensor not in self._seen:
            read = partial(
                trained_on,
                self.archive[sensor],
                self.split,
                settings=self.settings,
                device=self.device,
            )
            training = read("train")
            if training is None:
                raise LearningError(f"{sensor}: found no presses to train on in the split")
            self._seen[sensor] = training, read("validation")
        return self._seen[sensor]

    def _as_seen(self, presses: Presses) -> Presses:
        """Return presses as inputs of force models."""
        return presses if self.settings.memory else presses.each_frame_alone()

    def _tested_on(self, sensor: str) -> Tested:
        if sensor not in self._tested:
            self._tested[sensor] = tested_on(
                self.archive[sensor], self.split, self.settings, self.device
            )
        return self._tested[sensor]

    def _settings(self, *, tuning: bool = False) -> ForceSettings:
        return force_settings(self.settings, self.archive, self.device, tuning=tuning)

    def _file_of(self, tuning: Tuning) -> Path:
        return self._file(tuning.pair, tuning.method, tuning.translator)

    def _file(self, pair: Pair, method: str, translator: str) -> Path:
        parts = [f"{pair.source}-to-{pair.target}", method, translator, "npz"]
        return self.places.predictions / ".".join(part for part in parts if part)


def adopt_model(
    folder: Path,
    archive: MarkerArchive,
    sensor: str,
    split: Split,
    settings: ExperimentSettings,
    places: Places,
    device: str,
) -> ExperimentSettings:
    """Take a finished force model as that of a sensor; return settings with its network."""
    found = load_force_model(folder)
    keys = [("network", asdict(found.network)), ("input", asdict(found.inputs))]
    changed = [f"{key}.{name}={json.dumps(v)}" for key, each in keys for name, v in each.items()]
    force = replace(settings.force, set=(*settings.force.set, *changed))
    settings = replace(settings, force=force)
    forces = Forces(archive, split, settings, places, torch.device(device), 1, lambda line: None)
    forces.adopt(sensor, found)
    return settings


def _data(tuning: Tuning, shown: str) -> str:
    """Return what tells the data of a model: its frames, and the twins that labelled them."""
    labels = tuning.labels
    return f"{shown} {labels.made_from}" if isinstance(labels, Simulated) else shown


def relabelling(
    archive: MarkerArchive, pair: Pair, method: str, compensation: StoredCompensation | None
) -> Relabelling | None:
    """Return the compensation of a pair's labels for a method, or None."""
    if method == SIMULATED:
        return simulated_labels(archive[pair.source], archive[pair.target])
    if compensation is None or method not in CHOICE_OF_METHOD:
        return None
    return compensation.pair(pair.source, pair.target, CHOICE_OF_METHOD[method]).applied
