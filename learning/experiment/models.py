"""Models of an experiment: translators, trained by commands, and force models tuned in batches."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from learning.config import read_settings
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.experiment.parts import Pair
from learning.experiment.settings import ExperimentSettings, ModelChoice
from learning.experiment.translating import WithoutSourceReference
from learning.force.batched import train_batched
from learning.force.model import ForceModel
from learning.force.train import ForceSettings, Relabelling
from learning.training.run import RunFolder, Stop
from learning.translation.archive import Model
from learning.translation.direct import train, train_autoencoder
from learning.translation.field import train as field
from learning.translation.loading import hash_of, load_translator
from learning.translation.translator import FLOW
from recorder.command_line.errors import EXIT_INTERRUPTED
from recorder.command_line.run import main
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


def train_translator(
    places: Places,
    settings: ExperimentSettings,
    name: str,
    device: torch.device,
    say: Callable[[str], None],
) -> None:
    """Train a translator, unless it needs no training or is trained already.

    Raises:
        LearningError: The training was rejected.
        KeyboardInterrupt: It was interrupted; running the experiment again continues it.
    """
    for command in _commands(name, places, settings, device):
        run_command(command, say)


def open_translator(
    places: Places, settings: ExperimentSettings, name: str, device: torch.device
) -> Model:
    """Open a translator, without the source's reference if the settings exclude it.

    Raises:
        LearningError: It is not trained, or its files are corrupt.
    """
    folder: str | Path = name if name == FLOW else places.model(name)
    translator = load_translator(folder, device)
    if not settings.source_reference:
        translator = WithoutSourceReference(translator)
    return Model(translator, name, hash_of(folder), str(device))


def run_command(command: Sequence[str], say: Callable[[str], None]) -> None:
    """Run `python -m learning ...` in this process.

    Raises:
        LearningError: The command failed; it has printed the error.
        KeyboardInterrupt: It was interrupted.
    """
    message = "python -m learning " + " ".join(command)
    say(message)
    code = main(command, "learning")
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        raise LearningError(f"`{message}` ended with exit code {code}")


def _trainings(name: str) -> dict[str, tuple[Path, type]]:
    """Return presets and settings of a translator's trainings, by their key in the settings."""
    if name == "field":
        return {"field": (field.PRESETS, field.FieldSettings)}
    if name == "direct":
        return {
            "autoencoder": (train_autoencoder.PRESETS, train_autoencoder.AutoencoderSettings),
            "direct": (train.PRESETS, train.DirectSettings),
        }
    if name == "diffusion":
        # Needs libraries that the others do not.
        from learning.translation.diffusion import train as translator
        from learning.translation.diffusion import train_vae

        return {
            "marker_vae": (train_vae.PRESETS, train_vae.MarkerVaeSettings),
            "diffusion": (translator.PRESETS, translator.TranslatorSettings),
        }
    return {}


def check_translators(settings: ExperimentSettings) -> None:
    """Read the presets of all translators, which are used only hours later.

    Raises:
        LearningError: A preset or value is invalid, or there are no weights to start from.
    """
    for name in settings.translators:
        for key, (presets, kind) in _trainings(name).items():
            choice: ModelChoice = getattr(settings, key)
            try:
                found: Any = read_settings(
                    kind, presets, choice.preset, settings.overrides(*choice.set)
                )
                if name == "diffusion":
                    from learning.translation.diffusion.weights import require_base_folder

                    require_base_folder(found.weights.base)
            except LearningError as error:
                raise LearningError(f"{key}: {error}") from None


def _commands(
    name: str, places: Places, settings: ExperimentSettings, device: torch.device
) -> Iterator[list[str]]:
    """Yield the commands that train a translator, its own training last."""
    if name == "field":
        yield _training(places, "field", settings, device)
    if name == "direct":
        yield _training(places, "autoencoder", settings, device)
        begun = ["--autoencoder", str(places.model("autoencoder"))]
        yield [*_training(places, "direct", settings, device), *begun]
    if name == "diffusion":
        yield _training(places, "marker-vae", settings, device)
        begun = ["--marker-vae", str(places.model("marker-vae"))]
        yield [*_training(places, "diffusion", settings, device), *begun]


def _training(
    places: Places, kind: str, settings: ExperimentSettings, device: torch.device
) -> list[str]:
    choice: ModelChoice = getattr(settings, kind.replace("-", "_"))
    command = [f"train-{kind}", str(places.archive), "--split", str(places.split)]
    command += ["--out", str(places.model(kind)), "--resume", "--preset", choice.preset]
    for each in settings.overrides(*choice.set, f"launch.device={device.type}"):
        command += ["--set", each]
    return command


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

    Raises:
        LearningError: The models cannot share presses or settings, or a training diverged.
        KeyboardInterrupt: The training was stopped; nothing is stored.
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
