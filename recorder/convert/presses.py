"""The frames view cut into presses: consecutive rows of one target in one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.reader import Session

Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Press:
    """One target as it was pressed once."""

    target: int
    """Row of `targets`."""
    run: int
    """Entry of attrs `runs`."""
    rows: Rows
    """Rows of `frames` (n,), ascending in time."""


def presses(session: Session, *, valid_only: bool = False) -> list[Press]:
    """Return the presses in the order they were made; one without rows is left out.

    Rows without an image are left out where the session has a camera.

    Args:
        session: A finished session.
        valid_only: Leave out rows that are not `valid`.

    Raises:
        SessionError: No frames at all.
    """
    frames = session.frames
    if "t_ns" not in frames or not len(frames["t_ns"]):
        raise SessionError(f"{session.name}: has no frames to export")
    keep = frames["valid"] if valid_only else np.ones(len(frames["t_ns"]), np.bool_)
    if "camera" in session.streams:
        keep = keep & (frames["image"] >= 0)
    return list(_cut(frames, np.flatnonzero(keep).astype(np.int64)))


def _cut(frames: Mapping[str, Any], rows: Rows) -> Iterator[Press]:
    if not len(rows):
        return
    target, run = frames["target"][rows], frames["run"][rows]
    change = np.flatnonzero((np.diff(target) != 0) | (np.diff(run) != 0)) + 1
    for part in np.split(rows, change):
        yield Press(int(frames["target"][part[0]]), int(frames["run"][part[0]]), part)


def need_presses(session: Session, *, valid_only: bool) -> list[Press]:
    """Return `presses`, at least one.

    Raises:
        SessionError: There is none.
    """
    found = presses(session, valid_only=valid_only)
    if not found:
        what = "valid rows" if valid_only else "rows with an image"
        raise SessionError(f"{session.name}: its frames hold no {what}")
    return found
