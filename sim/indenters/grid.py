"""Regular grid on which the distance to a solid indenter is stored."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array

# Step between the nodes that are evaluated far from the surface.
SKIP = 4


@dataclass(frozen=True, slots=True)
class NodeGrid:
    """Nodes at integer multiples of a spacing, so that some have x = 0 or y = 0."""

    first: tuple[int, int, int]
    """Multiple of the spacing at the first node, along x, y and z; with multiples of `SKIP`, nodes
    that are skipped are the same on both sides of 0."""
    shape: tuple[int, int, int]
    spacing: float
    """Distance between neighbouring nodes [m]."""

    @property
    def count(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def positions(self, nodes: NDArray[np.int64]) -> Array:
        """Return the positions (..., 3) [m] of nodes (..., 3), counted from 0."""
        return np.asarray((nodes + np.array(self.first)) * self.spacing)

    def points(self) -> Array:
        """Return the positions of all nodes (count, 3) [m], z fastest."""
        return self.positions(np.indices(self.shape).reshape(3, -1).T)
