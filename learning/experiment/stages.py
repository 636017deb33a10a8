"""Stages of an experiment: translators, compensation, force models, predictions and scores.

Each result is a file; existing ones are read, not made again.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

from learning.compensation.fit import (
    CHOICE_OF_METHOD,
    StoredCompensation,
    gather_priors,
    read_stored,
    write_compensation,
)
from learning.compensation.simulated import SIMULATED, simulated_labels, twin_forces
from learning.config import read_settings
from learning.data.presses import Form, Presses
from learning.data.splits import Role, Split, read_split
from learning.errors import LearningError
from learning.evaluation.distribution import MARKER_GRID
from learning.evaluation.predictions import TARGET, Predictions, predictions_of, read_predictions
from learning.evaluation.translation import TranslationScores, read_scores, score_translation
from learning.experiment.frames import (
    TESTED,
    as_images,
    flow_fields,
    load_some,
    look_of,
    thinned,
    translate_presses,
    warp_presses,
)
from learning.experiment.settings import ExperimentSettings
from learning.force.batched import train_batched
from learning.force.labels import Relabelling, by_twins, compensated
from learning.force.loading import load_force_model
from learning.force.model import KIND, ForceModel
from learning.force.train import PRESETS, ForceModelSettings, total_steps, train_force
from learning.metrics import force_errors
from learning.training.checkpoint import read_model_folder
from learning.training.run import RunFolder, session_of
from learning.translation.archive import NamedTranslator, Pair, translate_archive
from learning.translation.field import train as field_training
from learning.translation.loading import hash_of, load_translator
from learning.translation.translator import FLOW, SensorView, for_pair
from recorder.archive import MarkerArchive, archive_fingerprint
from recorder.progress import ItemProgress

# Methods: the source's model as it is, and after fine-tuning on translated frames.
BEFORE, TRANSFERRED = "source-only", "transferred"


class Places:
    """Paths of an experiment."""

    def __init__(self, out: Path, archive: Path) -> None:
        self.out, self.archive = out, archive
        self.split = out / "split.json"
        """File of the roles of presses."""
        self.compensation = out / "compensation.json"
        """File of priors of skins, and choices for pairs."""
        self.predictions = out / "results"
        """Folder of predicted forces and scores of translations."""
        self.report = out / "report"
        """Folder of the report and its tables."""

    def model(self, name: str) -> Path:
        """Return the folder of a trained model."""
        return self.out / "models" / name


# Settings of the trainings: presets, with the overrides of the experiment.


def force_settings(
    experiment: ExperimentSettings, device: str, *, tuning: bool = False
) -> ForceModelSettings:
    """Return the settings of force models; with `tuning`, of fine-tuning on translated frames."""
    changed = (
        f"seed={experiment.seed}",
        *experiment.force.set,
        *(experiment.fine_tuning if tuning else ()),
        f"launch.device={torch.device(device).type}",
    )
    try:
        settings = read_settings(ForceModelSettings, PRESETS, experiment.force.preset, changed)
    except LearningError as error:
        raise LearningError(f"{'fine_tuning' if tuning else 'force'}: {error}") from None
    if settings.input.stored_form != "images":
        raise LearningError(
            f"force: found {experiment.force.preset}, which sees marker fields; allowed: a model "
            "that sees images, which is what is translated"
        )
    return settings


def translator_training(
    experiment: ExperimentSettings, name: str, *changed: str
) -> tuple[Callable[..., None], Any] | None:
    """Return what trains a translator in a folder, and its settings; None: it needs no training."""
    if name not in ("field", "diffusion"):
        return None
    train_in: Callable[..., None] = field_training.train_in
    presets = field_training.PRESETS
    kind: type = field_training.FieldSettings
    if name == "diffusion":
        # Needs libraries that the others do not.
        from learning.translation.diffusion import train as m2m

        train_in, presets, kind = m2m.train_in, m2m.PRESETS, m2m.TranslatorSettings
    choice = getattr(experiment, name)
    overrides = (f"seed={experiment.seed}", *choice.set, *changed)
    return train_in, read_settings(kind, presets, choice.preset, overrides)


def check_settings(experiment: ExperimentSettings, device: str) -> None:
    """Read the presets of all trainings, which are used only hours later."""
    for name in experiment.translators:
        try:
            training = translator_training(experiment, name)
            if training is not None and name == "diffusion":
                from learning.translation.diffusion.weights import require_base_folder

                require_base_folder(training[1].weights.base)
        except LearningError as error:
            raise LearningError(f"{name}: {error}") from None
    for tuning in (False, True):
        force_settings(experiment, device, tuning=tuning)


def by_formulae(settings: ExperimentSettings) -> bool:
    """Return True if labels are compensated by the paper's formulae."""
    return bool(CHOICE_OF_METHOD.keys() & set(settings.compensation))


def relabelling(
    archive: MarkerArchive, pair: Pair, method: str, stored: StoredCompensation | None
) -> Relabelling | None:
    """Return the labels of a source's frames for a target by a method; None: its own."""
    if method == SIMULATED:
        return by_twins(simulated_labels(archive[pair.source], archive[pair.target]))
    if stored is None or method not in CHOICE_OF_METHOD:
        return None
    return compensated(stored.pair(pair.source, pair.target, CHOICE_OF_METHOD[method]))


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """One model to fine-tune on translated frames."""

    pair: Pair
    method: str
    """Kind of its labels, a method of evaluations."""
    translator: str
    """Translator of its frames."""
    labels: Relabelling | None

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"force-{self.pair.name}.{self.method}.{self.translator}"

    @property
    def data(self) -> str:
        """Its data: the frames, and the twins that labelled them."""
        twins = "" if self.labels is None else self.labels.made_from
        return f"{self.pair.name} {twins}".rstrip()

    def labelled(self, presses: Presses) -> Presses:
        """Return presses with its labels."""
        return presses if self.labels is None else self.labels.of(presses)


@dataclass(eq=False)
class Experiment:
    """An experiment; caches what several of its parts read."""

    places: Places
    settings: ExperimentSettings
    pairs: tuple[Pair, ...]
    """Source and target sensors."""
    device: str = "cpu"
    """Device of training and translation."""
    processes: int = 1
    """Number of processes that track markers."""
    unlabelled: frozenset[str] = frozenset()
    """Targets without labels in training presses: no model is trained on their labels."""
    say: Callable[[str], None] = print
    """Called with a line for each completed part."""

    def __post_init__(self) -> None:
        self._tested: dict[str, Presses] = {}
        self._frames: dict[str, tuple[Presses, Presses]] = {}
        self._own: dict[str, tuple[Path, ForceModel]] = {}

    @cached_property
    def archive(self) -> MarkerArchive:
        """Frames of all sensors, with labels."""
        archive = MarkerArchive(self.places.archive)
        if SIMULATED in self.settings.compensation:
            for name in {name for pair in self.pairs for name in (pair.source, pair.target)}:
                twin_forces(archive[name])
        return archive

    @cached_property
    def split(self) -> Split:
        """Roles of presses."""
        return read_split(self.places.split)

    @cached_property
    def _data(self) -> str:
        return f"{archive_fingerprint(self.archive)} {self.split.fingerprint}"

    def run(self) -> tuple[list[Predictions], list[TranslationScores]]:
        """Make every part, and return predictions and scores.

        Each sensor has its own force model, and predictions on its own frames and on others'. Each
        source and translator has models that are fine-tuned on translated frames.
        """
        for name in self.settings.translators:
            self.train(name)
        if by_formulae(self.settings):
            self.compensate()
        sources = dict.fromkeys(pair.source for pair in self.pairs)
        sensors = dict.fromkeys([*sources, *(pair.target for pair in self.pairs)])
        predictions: list[Predictions] = []
        scores: list[TranslationScores] = []
        for sensor in sensors:
            if sensor not in self.unlabelled:
                predictions += self.own(sensor)
        for source in sources:
            for name in self.settings.translators:
                more, some = self.translated(source, name)
                predictions += more
                scores += some
        return predictions, scores

    def train(self, name: str) -> None:
        """Train a translator, if it needs training."""
        launched = f"launch.device={torch.device(self.device).type}"
        if (training := translator_training(self.settings, name, launched)) is not None:
            train_in, settings = training
            train_in(self.places.model(name), self.archive, self.split, settings)

    def compensate(self) -> None:
        """Fit priors of skins, and choose the compensation of each pair."""
        out = self.places.compensation
        if out.exists():
            return
        # An unlabelled target may have no force-depth curve.
        missing = self.unlabelled
        if missing:
            missing = missing & frozenset(gather_priors(self.archive).without)
        for name in sorted(missing):
            self.say(f"{name}: no force-depth curve, so labels are not compensated for it")
        pairs = [(p.source, p.target) for p in self.pairs if p.target not in missing]
        if pairs:
            lines = write_compensation(self.archive, out, pairs=pairs, split=self.places.split)
            self.say("\n".join(lines))

    def own(self, sensor: str) -> list[Predictions]:
        """Train a sensor's own model; predict its own forces and those of its targets."""
        comparisons = [(pair, BEFORE) for pair in self.pairs if pair.source == sensor]
        if any(pair.target == sensor for pair in self.pairs):
            comparisons.append((Pair(sensor, sensor), TARGET))
        model = partial(self._own_model, sensor)
        return [self._predicted(pair, method, "", model) for pair, method in comparisons]

    def translated(
        self, source: str, name: str
    ) -> tuple[list[Predictions], list[TranslationScores]]:
        """Fine-tune models on a source's translated frames; predict targets, score translations."""
        trained = translator_training(self.settings, name) is not None
        folder: str | Path = self.places.model(name) if trained else name
        translator = NamedTranslator(
            load_translator(folder, self.device), name, hash_of(folder), str(self.device)
        )
        pairs = [pair for pair in self.pairs if pair.source == source]
        file = self.places.compensation
        stored = read_stored(file) if by_formulae(self.settings) and file.exists() else None
        # Targets of the same scale share the fields computed from the source's frames.
        fields: dict[tuple[float, float], torch.Tensor] = {}
        at_once = max(1, self.settings.models_per_batch // (1 + len(self.settings.compensation)))
        predictions = []
        for first in range(0, len(pairs), at_once):
            tunings = [
                Tuning(pair, method, name, relabelling(self.archive, pair, method, stored))
                for pair in pairs[first : first + at_once]
                for method in (TRANSFERRED, *self._compensated(pair, stored))
            ]
            due = [one for one in tunings if not self._file(one.pair, one.method, name).exists()]
            frames = {
                pair: self._translated(pair, translator, fields)
                for pair in dict.fromkeys(one.pair for one in due)
            }
            if due and self.settings.models_per_batch > 1:
                self._tune_batched(due, frames)
            for one in tunings:
                model = partial(self._tuned_model, one, frames)
                predictions.append(self._predicted(one.pair, one.method, name, model))
        self._frames.pop(source, None)
        return predictions, self._scores(source, pairs, translator)

    def _compensated(self, pair: Pair, stored: StoredCompensation | None) -> list[str]:
        """Return the kinds of compensated labels; an unlabelled target may lack some or all."""
        methods: list[str] = list(self.settings.compensation)
        if pair.target not in self.unlabelled:
            return methods
        choices = {
            choice
            for each in (() if stored is None else stored.pairs)
            if (each.source, each.target) == (pair.source, pair.target)
            for choice in each.choices
        }
        return [
            method
            for method in methods
            if method == SIMULATED or CHOICE_OF_METHOD[method] in choices
        ]

    # Force models and their predictions.

    def _predicted(
        self,
        pair: Pair,
        method: str,
        translator: str,
        trained: Callable[[], tuple[Path, ForceModel]],
    ) -> Predictions:
        """Return the predictions on a target by a model that is trained only if needed."""
        file = self._file(pair, method, translator)
        if not file.exists():
            folder, model = trained()
            target, presses = self.archive[pair.target], self._presses_tested(pair.target)
            rows = presses.rows.numpy()
            predictions_of(
                target,
                self.archive.indenters,
                rows,
                self.split.role(target.table["location"][rows]),
                model.predict(presses),
                source=pair.source,
                method=method,
                translator=translator,
                model=read_model_folder(folder).hash(),
            ).write(file)
        predictions = read_predictions(file)
        by = f" by {translator}" if translator else ""
        scored = "no label to compare with"
        if predictions.is_scored:
            errors = force_errors(predictions.true, predictions.predicted, predictions.label_std)
            scored = f"R2{errors.of_axes} {errors.r2_mean:.3f}"
        self.say(f"{pair.source} to {pair.target}, {method}{by}: {scored}")
        return predictions

    def _file(self, pair: Pair, method: str, translator: str) -> Path:
        parts = [pair.name, method, translator, "npz"]
        return self.places.predictions / ".".join(part for part in parts if part)

    def _own_model(self, sensor: str) -> tuple[Path, ForceModel]:
        if sensor not in self._own:

            def frames() -> tuple[Presses, Presses | None]:
                packed, held = self._source(sensor)
                return as_images(packed), as_images(held) if len(held) else None

            settings = self._force_settings()
            self._own[sensor] = self._trained(f"force-{sensor}", settings, sensor, frames)
        return self._own[sensor]

    def _tuned_model(self, tuning: Tuning, frames: dict[Pair, Presses]) -> tuple[Path, ForceModel]:
        """Return the source's model after fine-tuning on translated frames."""
        _, own = self._own_model(tuning.pair.source)
        return self._trained(
            tuning.name,
            self._force_settings(tuning=True),
            tuning.data,
            lambda: (tuning.labelled(frames[tuning.pair]), None),
            start_from=own,
        )

    def _trained(
        self,
        name: str,
        settings: ForceModelSettings,
        data: str,
        frames: Callable[[], tuple[Presses, Presses | None]],
        *,
        start_from: ForceModel | None = None,
    ) -> tuple[Path, ForceModel]:
        """Return a model and its folder; its frames, for training and validation, are lazy."""
        folder = self.places.model(name)
        run = self._open(name, settings, data)
        if not run.finished:
            presses, held = frames()
            with session_of(run, settings.launch, f"steps of {name}") as session:
                train_force(
                    presses,
                    settings,
                    session,
                    validation=() if held is None else held,
                    start_from=start_from,
                )
        return folder, load_force_model(folder, self.device)

    def _tune_batched(self, tunings: list[Tuning], frames: dict[Pair, Presses]) -> None:
        """Train all models that do not exist yet in one batch, which keeps a GPU busy."""
        settings = self._force_settings(tuning=True)
        _, own = self._own_model(tunings[0].pair.source)
        runs = [(one, self._open(one.name, settings, one.data)) for one in tunings]
        due = [(one, run) for one, run in runs if not run.finished]
        if not due:
            return
        name = f"steps of {len(due)} models, {due[0][0].name} first"
        presses = [one.labelled(frames[one.pair]) for one, _ in due]
        with session_of(RunFolder.nowhere(), settings.launch, name) as session:
            models = train_batched(presses, settings, session, start_from=own)
            steps = total_steps(presses[:1], settings)
            for (_, run), model in zip(due, models or (), strict=False):
                run.finish(steps, {"model": model})

    def _open(self, name: str, settings: ForceModelSettings, data: str) -> RunFolder:
        data = f"{self._data} {data}"
        return RunFolder.open(self.places.model(name), KIND, settings, data)

    def _force_settings(self, *, tuning: bool = False) -> ForceModelSettings:
        return force_settings(self.settings, self.device, tuning=tuning)

    # Frames.

    def _source(self, sensor: str) -> tuple[Presses, Presses]:
        """Return a source's presses for training and for validation, packed."""
        if sensor not in self._frames:
            most = self.settings.train_presses
            training, held = (self._load(sensor, [role], most) for role in ("train", "validation"))
            if not len(training):
                raise LearningError(f"{sensor}: found no presses to train on in the split")
            self._frames[sensor] = training, held
        return self._frames[sensor]

    def _presses_tested(self, sensor: str) -> Presses:
        """Return a target's presses for which forces are predicted, as images."""
        if sensor not in self._tested:
            presses = self._load(sensor, TESTED, None, form="images")
            if not len(presses):
                roles = ", ".join(TESTED)
                raise LearningError(f"{sensor}: found no presses of {roles} in the split")
            self._tested[sensor] = presses
        return self._tested[sensor]

    def _load(
        self, sensor: str, roles: Sequence[Role], most: int | None, form: Form = "packed"
    ) -> Presses:
        return load_some(
            self.archive[sensor],
            self.split,
            roles,
            most,
            self.settings.seed,
            device=torch.device(self.device),
            form=form,
        )

    def _translated(
        self, pair: Pair, model: NamedTranslator, fields: dict[tuple[float, float], torch.Tensor]
    ) -> Presses:
        packed, _ = self._source(pair.source)
        source, target = self.archive[pair.source], self.archive[pair.target]
        views = SensorView.of(source), SensorView.of(target)
        look = look_of(target, packed, torch.device(self.device))
        name = f"frames of {pair.source} to {pair.target} by {model.name}"
        with ItemProgress(name, sys.stderr) as progress:
            if model.name != FLOW:
                translator = for_pair(model.translator, *views)
                return translate_presses(packed, look, translator, progress=progress)
            scale = views[0].pixels_of(views[1])
            if scale not in fields:
                fields[scale] = flow_fields(
                    packed, *views, processes=self.processes, progress=progress
                )
            return warp_presses(packed, look, fields[scale], progress=progress)

    def _scores(
        self, source: str, pairs: list[Pair], model: NamedTranslator
    ) -> list[TranslationScores]:
        """Translate some test presses into an archive, and score its sensors."""
        settings = self.settings
        if not settings.scored_presses:
            return []
        few = thinned(self.split, settings.scored_presses, settings.seed)
        roles = [role for role in TESTED if len(few.locations(role))]
        path = self.places.out / "translated" / f"{source}.{model.name}.markers.zarr"
        with ItemProgress(f"frames of {source} by {model.name}", sys.stderr) as progress:
            translate_archive(
                self.archive, path, pairs, model, split=few, roles=roles, progress=progress
            )
        scores = []
        for sensor in MarkerArchive(path).values():
            file = self.places.predictions / f"{sensor.name}.{model.name}.scores.npz"
            if not file.exists():
                score_translation(
                    self.archive, sensor, few, roles, MARKER_GRID, seed=settings.seed
                ).write(file)
            scores.append(read_scores(file))
        self.say(f"translations of {source} by {model.name} scored: {path}")
        return scores
