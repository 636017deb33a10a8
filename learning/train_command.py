"""What the verbs that train have in common: a run's folder, Ctrl-C, progress, what is told."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from learning.data.splits import Split, read_split
from learning.progress import Progress
from learning.training.run import EXIT_INTERRUPTED, RunFolder, Stop, accelerator, described
from recorder import MarkerArchive

if TYPE_CHECKING:
    import torch
    from accelerate import Accelerator


@dataclass(frozen=True, slots=True)
class Training:
    """What a training is given by the verb that asked for it."""

    run: RunFolder
    """Where it is kept; it is not finished."""
    accelerator: Accelerator
    """What it runs on."""
    stop: Stop
    """Ctrl-C; to be entered for as long as a step can be waited for."""
    reading: Progress
    """Told of the data that is read."""
    steps: Progress
    """Told of the steps that are done."""

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        device: torch.device = self.accelerator.device
        return device

    def stopping(self) -> bool:
        """Return whether this process was asked to stop."""
        return self.stop.asked


def open_data(options: argparse.Namespace) -> tuple[MarkerArchive, Split]:
    """Return the archive and the split that were named, which fit each other.

    Raises:
        LearningError: The split cannot be read, or was not made for this archive.
        SessionError: The archive cannot be read.
    """
    archive, split = MarkerArchive(options.archive), read_split(options.split)
    split.check(archive)
    return archive, split


def trained_on(options: argparse.Namespace, archive: MarkerArchive, split: Split) -> list[str]:
    """Return the sensors that were named, or all that the split does not hold out."""
    return options.sensors.split(",") if options.sensors else [*split.trained_sensors(archive)]


def run_training(
    options: argparse.Namespace,
    kind: str,
    settings: Any,
    data: str,
    train: Callable[[Training], Iterable[str] | None],
    *,
    reading: str = "images",
    facts: Mapping[str, Any] | None = None,
) -> int:
    """Begin a run, or go on with it, and say what became of it.

    Args:
        options: Of the verb; `out` and `resume` are read.
        kind: What is trained, one of `KINDS`.
        settings: Of the training; `launch` says where it runs.
        data: Fingerprint of what it is trained on.
        train: Reads the data, trains, and finishes the run unless it was stopped. Returns lines to
            be told in the end, in place of that it was trained.
        reading: What is counted while data is read.
        facts: What is known before and needed to use the model.

    Returns:
        The exit code: 0, or `EXIT_INTERRUPTED`.

    Raises:
        LearningError: Another run is there, or the training was refused.
    """
    launched = accelerator(settings.launch)
    with RunFolder.open(
        options.out,
        kind,
        settings,
        data,
        options.resume,
        facts=facts,
        writes=launched.is_main_process,
    ) as run:
        if run.finished:
            print(f"{options.out}: is finished")
            return 0
        print(described(launched), file=sys.stderr)
        stop = Stop(lambda line: print(line, file=sys.stderr))
        training = Training(
            run, launched, stop, Progress(reading, sys.stderr), Progress("steps", sys.stderr)
        )
        try:
            told = train(training)
        finally:
            training.reading.close()
            training.steps.close()
        if stop.agreed(launched) and not run.finished:
            print(f"{options.out}: stopped; --resume goes on", file=sys.stderr)
            return EXIT_INTERRUPTED
    for line in [f"{options.out}: trained"] if told is None else told:
        print(line)
    return 0
