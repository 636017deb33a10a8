"""Common part of all trainings in a folder: data, run folder, Ctrl-C, progress, final report."""

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from learning.data.splits import SPLIT, Split, training_split
from learning.training.run import RunFolder, Stop, TrainingSession, accelerator, described
from recorder.archive import MarkerArchive
from recorder.progress import ItemProgress


def open_data(options: argparse.Namespace) -> tuple[MarkerArchive, Split]:
    """Open the archive that the options name, and the split that they name or the archive's own."""
    archive = MarkerArchive(options.archive)
    return archive, training_split(archive, options.split, options.unseen)


def run_training(
    out: Path,
    kind: str,
    settings: Any,
    data: Iterable[str],
    train: Callable[[TrainingSession], Iterable[str] | None],
    *,
    split: Split | None = None,
    reading: str = "images",
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Begin or resume a run in `out`, train, and print the result.

    `data` are words that identify the training data, joined to its fingerprint. `train` reads the
    data, trains, and finishes the run unless it was stopped; it returns lines to print at the end,
    or None for the default line. The split is written to `split.json`; `reading` names the items
    that are counted while data is read; `metadata` is known before training and needed to
    use the model.
    """
    launched = accelerator(settings.launch)
    writes = launched.is_main_process
    run = RunFolder.open(out, kind, settings, " ".join(data), metadata=metadata, writes=writes)
    if run.finished:
        print(f"{out}: is finished")
        return
    if writes and split is not None:
        split.write(run.path / SPLIT)
        print(f"{run.path / SPLIT}: sha256 {split.fingerprint[:12]}", file=sys.stderr)
    print(described(launched), file=sys.stderr)
    stop = Stop(lambda line: print(line, file=sys.stderr))
    with ItemProgress(reading, sys.stderr) as items, ItemProgress("steps", sys.stderr) as steps:
        lines = train(TrainingSession(launched, run, stop, steps, items))
    if stop.agreed(launched) and not run.finished:
        print(f"{out}: stopped; the same command continues", file=sys.stderr)
        raise KeyboardInterrupt
    for line in [f"{out}: trained"] if lines is None else lines:
        print(line)
