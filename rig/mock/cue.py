"""What the replaying process and its emulators tell each other, in shared memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np

# Written once, when every driver is open and every writer records: when the tape starts [ns].
CUE = np.dtype([("start_ns", "<i8")])

# Codes of `POSITION.state`.
WAITING, PLAYING, ENDED, FAILED = range(4)

# How far an emulator is: its state, rows sent, and the recorded time, since the run's first sample,
# of the first row its reader has not taken [ns].
POSITION = np.dtype([("state", "<i8"), ("sent", "<i8"), ("t_ns", "<i8")])

# `POSITION.t_ns` of an emulator whose rows have all been taken.
FAR_NS = np.iinfo(np.int64).max // 2


def cue_path(folder: Path) -> Path:
    """The CUE record of a run folder."""
    return folder / "replay.cue"


def position_path(folder: Path, name: str) -> Path:
    """The POSITION record of one emulator."""
    return folder / f"{name}.position"
