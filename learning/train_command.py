"""Common part of the commands that train: data, run folder, Ctrl-C, progress, final report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from learning.data.splits import SPLIT, Split, training_split
from learning.training.run import RunFolder, Session, Stop, accelerator, described
from recorder import MarkerArchive
from recorder.command_line.errors import EXIT_INTERRUPTED
from recorder.progress import ItemProgress


def open_data(options: argparse.Namespace) -> tuple[MarkerArchive, Split]:
    """Open the archive that the options name, and the split that they name or the archive's own.

    Raises:
        LearningError: The split cannot be read or made, or was not made for this archive.
        SessionError: The archive cannot be read.
    """
    archive = MarkerArchive(options.archive)
    return archive, training_split(archive, options.split, options.unseen)


def trained_on(options: argparse.Namespace, archive: MarkerArchive, split: Split) -> list[str]:
    """Return the sensors that the options name, or all that the split does not hold out."""
    return [*(options.sensors or split.trained_sensors(archive))]


def run_training(
    options: argparse.Namespace,
    kind: str,
    settings: Any,
    data: Iterable[str],
    train: Callable[[Session], Iterable[str] | None],
    *,
    split: Split | None = None,
    reading: str = "images",
    metadata: Mapping[str, Any] | None = None,
) -> int:
    """Begin or resume a run, train, and print the result.

    Args:
        options: Options of the command; `out` and `resume` are read.
        kind: Kind of the model, one of `KINDS`.
        settings: Settings of the training; `launch` selects device and precision.
        data: Words that identify the training data, joined to its fingerprint.
        train: Reads the data, trains, and finishes the run unless it was stopped. Returns lines to
            print at the end, or None for the default line.
        split: Split of the presses; it is written to `split.json` in the run's folder.
        reading: Name of the items that are counted while data is read.
        metadata: Values known before training that are needed to use the model.

    Returns:
        The exit code: 0, or `EXIT_INTERRUPTED`.

    Raises:
        LearningError: Another run is in the folder, or the training was rejected.
    """
    launched = accelerator(settings.launch)
    writes = launched.is_main_process
    with RunFolder.open(
        options.out,
        kind,
        settings,
        " ".join(data),
        options.resume,
        metadata=metadata,
        writes=writes,
    ) as run:
        if run.finished:
            print(f"{options.out}: is finished")
            return 0
        if writes and split is not None:
            split.write(run.path / SPLIT)
            print(f"{run.path / SPLIT}: sha256 {split.fingerprint[:12]}", file=sys.stderr)
        print(described(launched), file=sys.stderr)
        stop = Stop(lambda line: print(line, file=sys.stderr))
        with (
            ItemProgress(reading, sys.stderr) as items,
            ItemProgress("steps", sys.stderr) as steps,
        ):
            told = train(Session(launched, run, stop, steps, items))
        if stop.agreed(launched) and not run.finished:
            print(f"{options.out}: stopped; continue with --resume", file=sys.stderr)
            return EXIT_INTERRUPTED
    for line in [f"{options.out}: trained"] if told is None else told:
        print(line)
    return 0
