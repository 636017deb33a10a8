"""The regular grid on which the distance to a solid indenter is kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Grid:
    """Nodes at whole multiples of a spacing, so that x = 0 and y = 0 hold some of them."""

    first: tuple[int, int, int]
    """Multiple at which the first node stands, along x, y and z."""
    shape: tuple[int, int, int]
    spacing: float
    """[m]."""

    @property
    def count(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def places(self, nodes: NDArray[np.int64]) -> Array:
        """Where nodes (..., 3), counted from 0, stand (..., 3) [m]."""
        places: Array = (nodes + np.array(self.first)) * self.spacing
        return places

    def points(self) -> Array:
        """Where all nodes stand (count, 3) [m], z fastest."""
        return self.places(np.indices(self.shape).reshape(3, -1).T)
