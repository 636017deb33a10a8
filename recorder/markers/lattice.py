"""The pixels of the untouched image at which a displacement field is kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.markers.packing import HEIGHT, WIDTH


@dataclass(frozen=True, slots=True)
class Lattice:
    """Evenly spaced pixels over the image and a margin around it.

    The material that is seen at pixel p before anything touches it is seen at p + d(p) in the
    frame; the margin is for material that a press brings into view.
    """

    step_px: int = 10
    """From one pixel of the lattice to the next."""
    margin_px: int = 40
    """How far it reaches beyond columns 0 and 640 and rows 0 and 480."""

    def __post_init__(self) -> None:
        """Refuse a lattice that does not end as it begins.

        Raises:
            ValueError: Not positive, or a step that does not divide the sides.
        """
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
        places = np.arange(-self.margin_px, side + self.margin_px + 1, self.step_px)
        return places.astype(np.float64)
