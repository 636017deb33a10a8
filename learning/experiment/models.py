"""Models of an experiment: translators, and force models tuned in batches."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from learning.config import read_settings
from learning.data.presses import Presses
from learning.data.splits import Split
from learning.errors import LearningError
from learning.experiment.parts import Pair
from learning.experiment.settings import ExperimentSettings, ModelChoice
from learning.force.batched import train_batched
from learning.force.labels import Relabelling
from learning.force.model import ForceModel
from learning.force.train import ForceSettings
from learning.training.run import RunFolder, Stop
from learning.translation.archive import Model
from learning.translation.field import train as field
from learning.translation.loading import hash_of, load_translator
from learning.translation.translator import FLOW
from recorder import MarkerArchive
from recorder.progress import ItemProgress


@dataclass(frozen=True, slots=True)
class Places:
    """Paths of an experiment."""

    out: Path
    """Folder of the experiment."""
    archive: Path
    """Archive of the training data."""

    @property
    def split(self) -> Path:
        """File of the roles of presses."""
        return self.out / "split.json"

    @property
    def compensation(self) -> Path:
        """File of priors of skins, and choices for pairs."""
        return self.out / "compensation.json"

    @property
    def predictions(self) -> Path:
        """Folder of predicted forces and scores of translations."""
        return self.out / "results"

    @property
    def report(self) -> Path:
        """Folder of the report and its tables."""
        return self.out / "report"

    def model(self, name: str) -> Path:
        """Return the folder of a trained model."""
        return self.out / "models" / name

    def translated(self, source: str, name: str) -> Path:
        """Return the archive of a source's translated frames for scoring."""
        return self.out / "translated" / f"{source}.{name}.markers.zarr"


@dataclass(frozen=True, slots=True)
class Training:
    """The training of a translator."""

    presets: Path
    """Folder of its presets."""
    kind: type
    """Class of its settings."""
    train_in: Callable[..., None]
    """Trains in a folder."""


def training_of(translator: str) -> Training | None:
    """Return the training of a translator; None: it needs none."""
    if translator == "field":
        return Training(field.PRESETS, field.FieldSettings, field.train_in)
    if translator == "diffusion":
        # Needs libraries that the others do not.
        from learning.translation.diffusion import train as m2m

        return Training(m2m.PRESETS, m2m.TranslatorSettings, m2m.train_in)
    return None


def training_settings(
    settings: ExperimentSettings, translator: str, training: Training, *changed: str
) -> Any:
    """Return the settings of a translator's training.

    Args:
        settings: Names a preset and its overrides.
        translator: Name of the translator.
        training: Its training.
        changed: Further overrides.
    """
    choice: ModelChoice = getattr(settings, translator)
    overrides = settings.overrides(*choice.set, *changed)
    return read_settings(training.kind, training.presets, choice.preset, overrides)


def train_translator(
    archive: MarkerArchive,
    split: Split,
    places: Places,
    settings: ExperimentSettings,
    name: str,
    device: torch.device,
) -> None:
    """Train a translator, unless it needs no training or is trained already."""
    if (training := training_of(name)) is not None:
        own = training_settings(settings, name, training, f"launch.device={device.type}")
        training.train_in(places.model(name), archive, split, own)


def open_translator(places: Places, name: str, device: torch.device) -> Model:
    """Open a translator."""
    folder: str | Path = name if name == FLOW else places.model(name)
    return Model(load_translator(folder, device), name, hash_of(folder), str(device))


def check_translators(settings: ExperimentSettings) -> None:
    """Read the presets of all translators, which are used only hours later."""
    for name in settings.translators:
        if (training := training_of(name)) is None:
            continue
        try:
            own = training_settings(settings, name, training)
            if name == "diffusion":
                from learning.translation.diffusion.weights import require_base_folder

                require_base_folder(own.weights.base)
        except LearningError as error:
            raise LearningError(f"{name}: {error}") from None


# Fine-tuning on translated frames, of several models at once to keep a GPU busy.


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """One model to fine-tune."""

    pair: Pair
    """Source and target sensor."""
    method: str
    """Kind of its labels, a method of evaluations."""
    translator: str
    """Translator of its frames."""
    labels: Relabelling | None
    """Relabelling of the labels."""

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"force-{self.pair.source}-to-{self.pair.target}.{self.method}.{self.translator}"


def tune_batched(
    tunings: Sequence[Tuning],
    shown: Mapping[Pair, Presses],
    settings: ForceSettings,
    start_from: ForceModel,
    open_run: Callable[[Tuning], RunFolder],
) -> None:
    """Train all models that do not exist yet in one batch, and store them.

    Args:
        tunings: The models.
        shown: Their training presses, as model inputs.
        settings: Settings of the training.
        start_from: Model with the initial weights.
        open_run: Opens the run folder of a model.
    """
    with ExitStack() as opened:
        runs = [opened.enter_context(open_run(each)) for each in tunings]
        due = [number for number, run in enumerate(runs) if not run.finished]
        if not due:
            return
        name = f"steps of {len(due)} models, {tunings[due[0]].name} first"
        taken = 0

        def passed(done: int, total: int) -> None:
            nonlocal taken
            taken = done
            steps(done, total)

        with (
            ItemProgress(name, sys.stderr) as steps,
            Stop(partial(print, file=sys.stderr)) as stop,
        ):
            trained = train_batched(
                [shown[tunings[number].pair] for number in due],
                settings,
                start_from=start_from,
                compensation=[tunings[number].labels for number in due],
                stopped=lambda: stop.asked,
                progress=passed,
            )
        if trained is None:
            raise KeyboardInterrupt
        for number, model in zip(due, trained, strict=True):
            runs[number].finish(taken, {"model": model})
