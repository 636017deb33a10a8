"""The translators of an experiment: trained by the commands that anyone would type, and opened."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from learning.errors import LearningError
from learning.experiment.blind import Blind
from learning.experiment.settings import ExperimentSettings, ModelChoice
from learning.training.stopping import EXIT_INTERRUPTED
from learning.translation.archive import Model, hash_of
from learning.translation.translator import FLOW, load_translator


@dataclass(frozen=True, slots=True)
class Places:
    """Where an experiment keeps what."""

    out: Path
    """Its folder."""
    archive: Path
    """What it learns from."""

    @property
    def split(self) -> Path:
        """Roles of presses."""
        return self.out / "split.json"

    @property
    def compensation(self) -> Path:
        """Priors of skins, and what was chosen for pairs."""
        return self.out / "compensation.json"

    @property
    def predictions(self) -> Path:
        """Predicted forces and scores of translations."""
        return self.out / "results"

    @property
    def report(self) -> Path:
        """The page and its tables."""
        return self.out / "report"

    def model(self, name: str) -> Path:
        """Return the folder of a trained model."""
        return self.out / "models" / name

    def translated(self, source: str, name: str) -> Path:
        """Return the archive of a source's translated frames that are scored."""
        return self.out / "translated" / f"{source}.{name}.markers.zarr"


def train_translator(
    places: Places,
    settings: ExperimentSettings,
    name: str,
    device: torch.device,
    say: Callable[[str], None],
) -> None:
    """Train a translator, if it has to be and is not yet.

    Raises:
        LearningError: A training that was refused.
        KeyboardInterrupt: It was interrupted; the same experiment goes on with it.
    """
    for command in _commands(name, places, settings, device):
        run_command(command, say)


def open_translator(
    places: Places, settings: ExperimentSettings, name: str, device: torch.device
) -> Model:
    """Return a translator, which is told of the source what the settings say.

    Raises:
        LearningError: It is not trained, or its files are damaged.
    """
    folder: str | Path = name if name == FLOW else places.model(name)
    translator = load_translator(folder, device)
    if not settings.source_reference:
        translator = Blind(translator)
    return Model(translator, name, hash_of(folder), str(device))


def run_command(command: Sequence[str], say: Callable[[str], None]) -> None:
    """Run `python -m learning ...` in this process.

    Raises:
        LearningError: It ended with an error, which it has printed.
        KeyboardInterrupt: It was interrupted.
    """
    from learning.__main__ import main

    said = "python -m learning " + " ".join(command)
    say(said)
    code = main(list(command))
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        raise LearningError(f"`{said}` ended with exit code {code}")


def _commands(
    name: str, places: Places, settings: ExperimentSettings, device: torch.device
) -> Iterator[list[str]]:
    """Return the commands that train a translator, the one that gives it last."""
    if name == "field":
        yield _training(places, "field", settings.field, device)
    if name == "direct":
        yield _training(places, "autoencoder", settings.autoencoder, device)
        begun = ["--autoencoder", str(places.model("autoencoder"))]
        yield [*_training(places, "direct", settings.direct, device), *begun]


def _training(places: Places, kind: str, choice: ModelChoice, device: torch.device) -> list[str]:
    command = [f"train-{kind}", str(places.archive), "--split", str(places.split)]
    command += ["--out", str(places.model(kind)), "--resume", "--preset", choice.preset]
    for each in (*choice.set, f"launch.device={device.type}"):
        command += ["--set", each]
    return command
