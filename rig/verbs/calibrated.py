"""Options of verbs that record with what was measured of the bench, and what they print of it."""

from __future__ import annotations

import argparse
from pathlib import Path

from recorder import Session
from rig.bench import Bench
from rig.calibrate import store
from rig.calibration import Calibration


def calibration_options(parser: argparse.ArgumentParser) -> None:
    """Where the calibrations lie."""
    parser.add_argument(
        "--calibrations",
        type=Path,
        default=store.FOLDER,
        help="folder of what home and calibrate-latency measured (%(default)s)",
    )


def calibration_of(options: argparse.Namespace, bench: Bench, indenter: str) -> Calibration:
    """What holds for this session: the file's, or of a session to resume what it began with.

    Prints what it is, and warnings.

    Args:
        options: With `calibrations`, and perhaps `resume`.
        bench: As its file describes it.
        indenter: Name of the indenter on the arm.

    Raises:
        ConfigError: A calibration that cannot be used; see `rig.calibrate.store.load`.
        SessionError: The session to resume cannot be read.
    """
    resumed: Path | None = getattr(options, "resume", None)
    warnings: list[str] = []
    if resumed is not None:
        facts = Session(resumed).attrs.get("calibration") or {}
        calibration = Calibration.from_facts(facts)
    else:
        calibration, warnings = store.load(options.calibrations, bench, indenter)
    for line in (*calibration.lines(), *(f"warning: {warning}" for warning in warnings)):
        print(line, flush=True)
    return calibration
