"""Lattice of pixels of the contact-free image at which a displacement field is stored."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.markers.masks import HEIGHT, WIDTH


@dataclass(frozen=True, slots=True)
class Lattice:
    """Evenly spaced pixels over the image and a margin around it.

    Material that is seen at pixel p without contact is seen at p + d(p) in the frame; the margin is
    for material that a press brings into view.
    """

    step_px: int = 10
    """Spacing of the lattice."""
    margin_px: int = 40
    """Extent beyond columns 0 and 640 and rows 0 and 480."""

    def __post_init__(self) -> None:
        sides = WIDTH + 2 * self.margin_px, HEIGHT + 2 * self.margin_px
        if self.step_px < 1 or self.margin_px < 0 or any(side % self.step_px for side in sides):
            raise ValueError(
                f"lattice: found step_px {self.step_px}, margin_px {self.margin_px}; allowed: a "
                f"step that divides {sides[0]} and {sides[1]}, no negative margin"
            )

    @property
    def columns(self) -> NDArray[np.float64]:
        """Columns of the lattice [px], from -margin to 640 + margin."""
        return self._along(WIDTH)

    @property
    def rows(self) -> NDArray[np.float64]:
        """Rows of the lattice [px], from -margin to 480 + margin."""
        return self._along(HEIGHT)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of one field: rows, columns and the two components (column, row)."""
        return (len(self.rows), len(self.columns), 2)

    def _along(self, side: int) -> NDArray[np.float64]:
        pixels = np.arange(-self.margin_px, side + self.margin_px + 1, self.step_px)
        return pixels.astype(np.float64)


# Detection of steep flanks in a displacement field: seen edge-on, they make markers hard to see.

Floats = NDArray[np.float64]

# Ratio of a cell's area in the frame to its area without contact, below which it may hide a
# marker. It is the mean over a cell that an edge crosses somewhere: part of it is steeper still.
STEEP = 0.45


def moved(centres: Floats, field: NDArray[np.floating], lattice: Lattice) -> Floats:
    """Return the positions to which a field moves pixels (n, 2); NaN beyond its material.

    They are column and row in the image without contact [px], the field (h, w, 2) [px].
    """
    column, row, along, down = _cells(centres, lattice)
    values = field.astype(np.float64)
    top = values[row, column] * (1 - along) + values[row, column + 1] * along
    low = values[row + 1, column] * (1 - along) + values[row + 1, column + 1] * along
    return np.asarray(centres + top * (1 - down) + low * down)


def on_flanks(centres: Floats, field: NDArray[np.floating], lattice: Lattice) -> NDArray[np.bool_]:
    """Return a mask (n,) of the pixels (n, 2) on a steep flank or in a lattice cell next to one.

    The area ratio of a cell is the determinant of the displaced image's derivative. Arguments as
    for `moved`.
    """
    values = field.astype(np.float64) / lattice.step_px
    # Derivatives on cell edges, averaged over a cell; NaN (no material) does not count as steep.
    across = (np.diff(values, axis=1)[1:] + np.diff(values, axis=1)[:-1]) / 2
    down = (np.diff(values, axis=0)[:, 1:] + np.diff(values, axis=0)[:, :-1]) / 2
    size = (1 + across[..., 0]) * (1 + down[..., 1]) - across[..., 1] * down[..., 0]
    steep = np.pad(size < STEEP, 1)
    column, row, _, _ = _cells(centres, lattice)
    flank = np.zeros(len(centres), np.bool_)
    for rows in range(3):
        for columns in range(3):
            flank |= steep[row + rows, column + columns]
    return flank


def _cells(
    centres: Floats, lattice: Lattice
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, Floats]:
    """Return column and row of the cells of pixels, and the fractions along and down (n, 1)."""
    position = (centres + lattice.margin_px) / lattice.step_px
    most = np.array([lattice.shape[1], lattice.shape[0]]) - 2
    cell = np.clip(np.floor(position).astype(np.int64), 0, most)
    fraction = position - cell
    return cell[:, 0], cell[:, 1], fraction[:, :1], fraction[:, 1:]
