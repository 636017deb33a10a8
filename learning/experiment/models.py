"""The models of an experiment: translators, trained by commands, and force models tuned at once."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from learning.command import run
from learning.compensation import command as compensate
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.experiment.parts import Pair
from learning.experiment.settings import ExperimentSettings, ModelChoice
from learning.experiment.translating import Blind
from learning.force.data import Compensation
from learning.force.model import ForceSettings
from learning.force.predict import ForcePredictor
from learning.force.train import train_together
from learning.progress import Progress
from learning.training.run import EXIT_INTERRUPTED, RunFolder, Stop
from learning.translation.archive import Model, hash_of
from learning.translation.direct import autoencoder_command as train_autoencoder
from learning.translation.direct import command as train_direct
from learning.translation.field import command as train_field
from learning.translation.loading import load_translator
from learning.translation.translator import FLOW


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
    said = "python -m learning " + " ".join(command)
    say(said)
    code = run(_parser(), command)
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        raise LearningError(f"`{said}` ended with exit code {code}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learning")
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in (compensate, train_field, train_autoencoder, train_direct):
        verb.add_to(verbs)
    return parser


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


# Models that learn from translated frames, several at once: what a GPU needs to be kept busy.


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """One of the models."""

    pair: Pair
    """From which sensor to which."""
    method: str
    """What its labels are, as evaluations call it."""
    translator: str
    """What made its frames."""
    labels: Compensation | None
    """What changes the labels."""

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"force-{self.pair.source}-to-{self.pair.target}.{self.method}.{self.translator}"


def tune_together(
    tunings: Sequence[Tuning],
    shown: Mapping[Pair, Presses],
    settings: ForceSettings,
    start_from: ForcePredictor,
    open_run: Callable[[Tuning], RunFolder],
) -> None:
    """Train the models that are not there yet, all at once, and store them.

    Args:
        tunings: Which.
        shown: What they learn from, as they see it.
        settings: How.
        start_from: What they begin with.
        open_run: Opens the folder of one.

    Raises:
        LearningError: Presses or settings that they cannot share, or a training that diverged.
        KeyboardInterrupt: It was stopped; nothing of it is stored.
    """
    with ExitStack() as opened:
        runs = [opened.enter_context(open_run(each)) for each in tunings]
        due = [number for number, run in enumerate(runs) if not run.finished]
        if not due:
            return
        steps = Progress(f"steps of {len(due)} models, {tunings[due[0]].name} first", sys.stderr)
        taken = 0

        def passed(done: int, total: int) -> None:
            nonlocal taken
            taken = done
            steps(done, total)

        try:
            with Stop(partial(print, file=sys.stderr)) as stop:
                trained = train_together(
                    [shown[tunings[number].pair] for number in due],
                    settings,
                    start_from=start_from,
                    compensation=[tunings[number].labels for number in due],
                    stopped=lambda: stop.asked,
                    progress=passed,
                )
        finally:
            steps.close()
        if trained is None:
            raise KeyboardInterrupt
        for number, predictor in zip(due, trained, strict=True):
            runs[number].finish(taken, {"model": predictor.model})
