"""Material coefficients: force over depth as polynomials, one for loading, one for unloading."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.genforce.columns import read_depths

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Compensation:
    """Force over depth of one sensor, as `numpy.poly1d` has it: highest power first."""

    down: tuple[float, ...]
    """Loading."""
    up: tuple[float, ...]
    """Unloading."""

    def force(self, depth: Array, *, loading: bool) -> Array:
        """Return the forces at depths (n,), in the units of the files."""
        return np.asarray(np.polyval(self.down if loading else self.up, depth), np.float64)


def read_coefficients(path: Path) -> tuple[float, ...]:
    """Return the coefficients in a file: one a line, or in one line with commas.

    Raises:
        LearningError: Not there, empty, or a value that is no number.
    """
    try:
        text = path.read_text(encoding="utf-8").strip()
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise LearningError(f"{path}: no text: {error}") from error
    if not text:
        raise LearningError(f"{path}: is empty; expected coefficients, highest power first")
    if "\n" in text:
        return tuple(float(value) for value in read_depths(path))
    try:
        values = tuple(float(value) for value in text.split(","))
    except ValueError:
        raise LearningError(f"{path}: found {text!r}; expected numbers") from None
    if not np.isfinite(values).all():
        raise LearningError(f"{path}: found NaN or infinity; expected numbers")
    return values


def write_coefficients(path: Path, values: tuple[float, ...]) -> None:
    """Write coefficients, one a line: they come back as they are."""
    path.write_text("".join(f"{float(value)!r}\n" for value in values))


def read_compensation(folder: Path) -> dict[str, Compensation]:
    """Return the coefficients of every sensor in a folder: <sensor>_down.csv, <sensor>_up.csv.

    Raises:
        LearningError: No such folder, none in it, or a file without its other half.
    """
    if not folder.is_dir():
        raise LearningError(f"{folder}: no such folder")
    names = sorted(
        {path.stem.rpartition("_")[0] for path in folder.glob("*_*.csv") if _is_half(path)}
    )
    if not names:
        raise LearningError(f"{folder}: found no <sensor>_down.csv and <sensor>_up.csv")
    return {
        name: Compensation(
            read_coefficients(folder / f"{name}_down.csv"),
            read_coefficients(folder / f"{name}_up.csv"),
        )
        for name in names
    }


def _is_half(path: Path) -> bool:
    return path.stem.endswith(("_down", "_up"))
