# mypy: ignore-errors
# Holds Warp arrays, typed at run time; mypy cannot follow them.
"""Signed distance of patterns, sampled over the gel: their representation for rendering."""

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from sim.arrays import Array
from sim.errors import SceneError, check_range
from sim.markers.pattern import Pattern
from sim.scene import Body

# Spacing of samples [m], with which the edge of a disc of 0.25 mm radius is at most 0.2 um off.
STEP = 20e-6
# Range of the distance around a marker [m]; several pixels of every camera in use.
BAND = 0.25e-3


class Textures:
    """Signed distance to the markers of P patterns over the whole top of a gel, on a device.

    It is negative inside a marker, and bilinear between samples.
    """

    def __init__(
        self, patterns: Sequence[Pattern], body: Body, *, step: float = STEP, device: str = "cpu"
    ) -> None:
        """Sample patterns every `step` [m]."""
        if not patterns:
            raise SceneError("patterns: none; allowed: at least one")
        check_range("texture", "step", step, 1e-6, 1e-3, unit="m")
        x, y = (_samples(size, step) for size in (body.size_x, body.size_y))
        distances = []
        for pattern in patterns:
            pattern.check_within(body)
            values = pattern.distance(x, y, max(BAND, 2 * step))
            if body.footprint != "rectangle":  # clipped at the gel's border
                values = np.maximum(values, -body.from_side(x, y[:, None]))
            distances.append(values.astype(np.float32))
        self.values = wp.array(np.stack(distances), device=device)
        """Distances (P, Y, X) [m], x and y ascending."""
        self.corner = float(x[0]), float(y[0])
        """x and y of the first value [m]."""
        self.step = step
        """Distance between neighbours [m]."""

    def __len__(self) -> int:
        return len(self.values)


def _samples(size: float, step: float) -> Array:
    """Return sample positions, centred on 0, that cover `size`."""
    count = math.ceil(size / step - 1e-9) + 1
    return np.asarray((np.arange(count) - (count - 1) / 2) * step)
