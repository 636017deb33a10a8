"""Shared memory records between the replaying process and its emulators."""

from __future__ import annotations

from pathlib import Path

import numpy as np

# Start time of playback [ns], written once all drivers are open and all writers record.
SYNC = np.dtype([("start_ns", "<i8")])

# Codes of `POSITION.state`.
WAITING, PLAYING, ENDED, FAILED = range(4)

# Progress of an emulator: its state, rows sent, and the recorded time of the first row that its
# reader has not taken, relative to the run's first sample [ns].
POSITION = np.dtype([("state", "<i8"), ("sent", "<i8"), ("t_ns", "<i8")])

# `POSITION.t_ns` of an emulator all of whose rows have been taken.
FAR_NS = np.iinfo(np.int64).max // 2


def sync_path(folder: Path) -> Path:
    """Return the path of a run folder's CUE record."""
    return folder / "replay.cue"


def position_path(folder: Path, name: str) -> Path:
    """Return the path of an emulator's POSITION record."""
    return folder / f"{name}.position"
