"""`tactile score-transfer`: compare a transferred model and its intervals with true forces."""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.cli.archive_join import chosen_sensors
from learning.errors import LearningError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Predicts the target's frames of indenters that no stage of a transfer learned from, and "
        "compares forces and intervals with labels of its archive, which the transfer did not read."
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="RUN/model, or one with a scale")
    parser.add_argument(
        "truth", metavar="ARCHIVE:SENSOR", help="the target's frames with true forces"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.transfer.score import score

    sensors = list(chosen_sensors(options.truth))
    if len(sensors) != 1:
        raise LearningError(f"ARCHIVE:SENSOR: found {options.truth!r}; allowed: one sensor")
    for line in score(options.model, sensors[0]).lines():
        print(line)
    return 0
