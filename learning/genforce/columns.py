"""Text files of numbers: forces, poses, depths, and the list of a press's last frames."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.convert.genforce_format import FORCE_COLUMNS, POSE_COLUMNS

Array = NDArray[np.float64]


def read_forces(path: Path) -> tuple[Array, bool]:
    """Return the wrenches (n, 6) of an ft.csv [N, N m], and whether it has torques.

    Torques are 0 where the file has forces alone.

    Raises:
        LearningError: Not there, other columns, or a value that is no number.
    """
    names, rows = _table(path)
    if names not in (FORCE_COLUMNS, FORCE_COLUMNS[:3]):
        raise LearningError(
            f"{path}: found columns {', '.join(names)}; expected {', '.join(FORCE_COLUMNS)}"
        )
    wrench = np.zeros((len(rows), 6))
    wrench[:, : rows.shape[1]] = rows
    wrench[:, 3:] /= 1e3  # N mm -> N m
    return wrench, rows.shape[1] == 6


def write_forces(path: Path, wrench: Array) -> None:
    """Write wrenches (n, 6) [N, N m] as an ft.csv; forces come back as they are."""
    scaled = wrench.copy()
    scaled[:, 3:] *= 1e3
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(FORCE_COLUMNS)
        out.writerows([repr(float(value)) for value in row] for row in scaled)


def read_poses(path: Path) -> Array:
    """Return the poses (n, 6) of a pose.csv [m, rad].

    Raises:
        LearningError: Not there, other columns, or a value that is no number.
    """
    names, rows = _table(path)
    if names != POSE_COLUMNS:
        raise LearningError(
            f"{path}: found columns {', '.join(names)}; expected {', '.join(POSE_COLUMNS)}"
        )
    return rows


def read_depths(path: Path) -> Array:
    """Return the numbers (n,) of an inc_z.csv or dec_z.csv [mm]: one a line, no header.

    Raises:
        LearningError: Not there, or a line that is not one number.
    """
    rows = [line.split(",") for line in _lines(path)]
    values = [_numbers(row, path, number + 1) for number, row in enumerate(rows)]
    if any(len(row) != 1 for row in values):
        raise LearningError(f"{path}: found several values in a line; expected one")
    return np.array([row[0] for row in values], np.float64)


def write_depths(path: Path, depth_mm: Array) -> None:
    """Write depths (n,) [mm], one a line."""
    path.write_text("".join(f"{float(value)!r}\n" for value in depth_mm))


def read_last(path: Path, frames: int) -> tuple[int, ...]:
    """Return the numbers of the last frames of the four phases, from a last.csv.

    Raises:
        LearningError: Not there, not four, not in their order, or not those of the folder.
    """
    names = [line.strip() for line in _lines(path)]
    stems = [PureWindowsPath(name).stem for name in names]
    if len(stems) != 4 or not all(stem.isdecimal() for stem in stems):
        raise LearningError(f"{path}: found {names}; expected the names of four frames")
    last = tuple(int(stem) for stem in stems)
    if any(b <= a for a, b in pairwise(last)):
        raise LearningError(f"{path}: found frames {last}; expected them in ascending order")
    if last[-1] != frames - 1:
        raise LearningError(
            f"{path}: says that the last frame is {last[-1]}; its folder has {frames} frames"
        )
    return last


def write_last(path: Path, names: Sequence[str]) -> None:
    """Write the names of the last frames of the phases, one a line."""
    path.write_text("".join(f"{name}\n" for name in names))


def _table(path: Path) -> tuple[tuple[str, ...], Array]:
    lines = list(csv.reader(_lines(path)))
    if not lines:
        raise LearningError(f"{path}: is empty; expected a header and a row a frame")
    names = tuple(name.strip() for name in lines[0])
    rows = [_numbers(row, path, number + 2) for number, row in enumerate(lines[1:])]
    for number, row in enumerate(rows):
        if len(row) != len(names):
            raise LearningError(
                f"{path}: line {number + 2}: found {len(row)} values; expected {len(names)}"
            )
    return names, np.array(rows, np.float64).reshape(len(rows), len(names))


def _numbers(row: Sequence[str], path: Path, line: int) -> list[float]:
    try:
        values = [float(value) for value in row]
    except ValueError:
        raise LearningError(f"{path}: line {line}: found {row}; expected numbers") from None
    if not all(math.isfinite(value) for value in values):
        raise LearningError(f"{path}: line {line}: found NaN or infinity; expected numbers")
    return values


def _lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise LearningError(f"{path}: no text: {error}") from error
    return [line for line in text.splitlines() if line.strip()]
