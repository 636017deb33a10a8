"""Where a displacement field says that markers are hard to see: flanks that are seen end-on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recorder.markers.lattice import Lattice

Floats = NDArray[np.float64]

STEEP = 0.45
"""Size of a patch of skin in the frame over its size untouched below which it may hide a marker.
It is the mean of a cell, which an edge crosses somewhere: part of it is steeper still."""


def moved(centres: Floats, field: NDArray[np.floating], lattice: Lattice) -> Floats:
    """Return where a field says that pixels (n, 2) are seen; NaN beyond its material.

    Args:
        centres: Column and row in the untouched image [px].
        field: Displacement (h, w, 2) [px].
        lattice: Where it is kept.
    """
    column, row, along, down = _cells(centres, lattice)
    values = field.astype(np.float64)
    top = values[row, column] * (1 - along) + values[row, column + 1] * along
    low = values[row + 1, column] * (1 - along) + values[row + 1, column + 1] * along
    return np.asarray(centres + top * (1 - down) + low * down)


def on_flanks(centres: Floats, field: NDArray[np.floating], lattice: Lattice) -> NDArray[np.bool_]:
    """Return which pixels (n, 2) lie on a steep flank, or a cell of the lattice beside one (n,).

    How much a cell shrinks is the determinant of the displaced image's derivative. Arguments as for
    `moved`.
    """
    values = field.astype(np.float64) / lattice.step_px
    # Derivatives on the edges of cells, averaged over a cell; NaN, without material, is not steep.
    across = (np.diff(values, axis=1)[1:] + np.diff(values, axis=1)[:-1]) / 2
    down = (np.diff(values, axis=0)[:, 1:] + np.diff(values, axis=0)[:, :-1]) / 2
    size = (1 + across[..., 0]) * (1 + down[..., 1]) - across[..., 1] * down[..., 0]
    steep = np.pad(size < STEEP, 1)
    column, row, _, _ = _cells(centres, lattice)
    found = np.zeros(len(centres), np.bool_)
    for rows in range(3):
        for columns in range(3):
            found |= steep[row + rows, column + columns]
    return found


def _cells(
    centres: Floats, lattice: Lattice
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, Floats]:
    """Return column and row of the cells that pixels are in, and how far along and down (n, 1)."""
    place = (centres + lattice.margin_px) / lattice.step_px
    most = np.array([lattice.shape[1], lattice.shape[0]]) - 2
    cell = np.clip(np.floor(place).astype(np.int64), 0, most)
    share = place - cell
    return cell[:, 0], cell[:, 1], share[:, :1], share[:, 1:]
