"""Models that learn from translated frames, several at once: what a GPU needs to be kept busy."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

from learning.data.presses import Presses
from learning.experiment.parts import Pair
from learning.force.labels import Compensation
from learning.force.predictor import ForcePredictor
from learning.force.settings import ForceSettings
from learning.force.together import train_together
from learning.progress import Progress
from learning.training.run_folder import RunFolder
from learning.training.stopping import Stop


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
