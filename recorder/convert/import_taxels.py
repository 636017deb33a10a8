"""Taxel counts from an .npy file, rounded to the integers that the device transmits."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_force import load_npy
from recorder.errors import SessionError

_COUNT_MAX = 0xFFFF


@dataclass(frozen=True, slots=True)
class Counts:
    """Taxels to import."""

    value: NDArray[np.int32]
    """Counts (n, 16, 3), each a uint16."""
    rate_hz: float
    """Scans per second."""
    assumed: list[str] = field(default_factory=list)
    """Messages on assumptions and changes."""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return len(self.value) / self.rate_hz


def read_taxels(path: Path, rate_hz: float | None) -> Counts:
    """Return the counts of a (n, 48) or (n, 16, 3) .npy file: x y z of each taxel, row by row.

    Args:
        path: The file.
        rate_hz: Scans per second.

    Raises:
        SessionError: A different shape, a row that is NaN, negative or beyond uint16, or no rate.
        OSError: The file cannot be read.
    """
    array = load_npy(path)
    if array.shape[1:] not in ((48,), (16, 3)):
        raise SessionError(f"{path.name}: found shape {array.shape}; allowed: (n, 48), (n, 16, 3)")
    if rate_hz is None:
        raise SessionError(f"{path.name}: says no times; say --taxels-hz")
    values = array.reshape(len(array), 48).astype(np.float64)
    whole = np.rint(values)
    bad = np.flatnonzero(~((whole >= 0) & (whole <= _COUNT_MAX)).all(axis=1))
    if bad.size:
        row = values[bad[0]]
        worst = row[~((np.rint(row) >= 0) & (np.rint(row) <= _COUNT_MAX))][0]
        raise SessionError(
            f"{path.name}: row {bad[0]}: found {worst:g}; allowed: 0 to {_COUNT_MAX} counts "
            f"({bad.size} such rows)"
        )
    assumed = [f"{path.name}: {rate_hz:g} rows/s by --taxels-hz"]
    largest = float(np.abs(values - whole).max())
    if largest > 0:
        assumed.append(
            f"{path.name}: rounded to whole counts, as the device sends them; largest change "
            f"{largest:.3g} counts"
        )
    return Counts(whole.astype(np.int32).reshape(-1, 16, 3), rate_hz, assumed)
