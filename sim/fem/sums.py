"""What the sums over a state say of each environment of a batch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sums:
    """The columns that `nodes.residual_kernel` writes, by name; forces in E T^2."""

    totals: Array
    """(B, `nodes.SUMS`)."""

    @property
    def square(self) -> Array:
        """Square of what is out of balance (B,)."""
        return self.totals[:, 0]

    @property
    def applied(self) -> Array:
        """Square of the nodal forces of contact and weight (B,)."""
        return self.totals[:, 1]

    @property
    def slope(self) -> Array:
        """-(out of balance) . direction (B,)."""
        return self.totals[:, 2]

    @property
    def det(self) -> Array:
        """Smallest determinant of the deformation gradient (B,)."""
        return self.totals[:, 3]

    @property
    def contact(self) -> Array:
        """Force of the indenter on the body (B, 3)."""
        return self.totals[:, 4:7]

    @property
    def base(self) -> Array:
        """Force of the base on the body (B, 3)."""
        return self.totals[:, 7:10]
