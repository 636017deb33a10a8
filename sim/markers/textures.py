# mypy: ignore-errors
# Holds Warp arrays, typed at run time; mypy cannot follow them.
"""Signed distance of a pattern, sampled over the gel: its representation for rendering."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.errors import SceneError, check_range
from sim.markers.pattern import Pattern
from sim.scene import Body

Array = NDArray[np.float64]

# Spacing of samples [m], with which the edge of a disc of 0.25 mm radius is at most 0.2 um off.
STEP = 20e-6
# Range of the distance around a marker [m]; several pixels of every camera in use.
BAND = 0.25e-3


@dataclass(frozen=True, slots=True, eq=False)
class DistanceTexture:
    """Signed distance to the nearest edge of a marker, negative inside; bilinear interpolation."""

    name: str
    values: NDArray[np.float32]
    """Distances (Y, X) [m]; x along the second axis, y ascending along the first."""
    corner: tuple[float, float]
    """x and y of the first value [m]."""
    step: float
    """Distance between neighbours [m]."""


def distance_texture(pattern: Pattern, body: Body, *, step: float = STEP) -> DistanceTexture:
    """Return the texture of a pattern over the whole top of a gel.

    Raises:
        SceneError: A marker lies beyond the gel's border, or the step is out of range.
    """
    check_range("texture", "step", step, 1e-6, 1e-3, unit="m")
    pattern.check_within(body)
    x, y = (_samples(size, step) for size in (body.size_x, body.size_y))
    values = pattern.distance(x, y, max(BAND, 2 * step))
    if body.footprint != "rectangle":
        values = np.maximum(values, -body.from_side(x, y[:, None]))  # clipped at the gel's border
    values = values.astype(np.float32)
    return DistanceTexture(pattern.name, values, (float(x[0]), float(y[0])), step)


def _samples(size: float, step: float) -> Array:
    """Return sample positions, centred on 0, that cover `size`."""
    count = math.ceil(size / step - 1e-9) + 1
    return np.asarray((np.arange(count) - (count - 1) / 2) * step)


# Distance textures of several patterns on one device.


class Textures:
    """Textures of P patterns of one gel on a device."""

    def __init__(self, textures: Sequence[DistanceTexture], device: str) -> None:
        """Copy textures to the device.

        Raises:
            SceneError: There are none, or some differ in size or position.
        """
        if not textures:
            raise SceneError("patterns: none; allowed: at least one")
        first = textures[0]
        for other in textures[1:]:
            alike = other.values.shape == first.values.shape
            if not alike or (other.corner, other.step) != (first.corner, first.step):
                raise SceneError(
                    f"pattern {other.name!r}: {other.values.shape} samples from {other.corner}, "
                    f"every {other.step} m; allowed: as {first.name!r}, {first.values.shape} from "
                    f"{first.corner}, every {first.step} m"
                )
        self.names = tuple(texture.name for texture in textures)
        """Names of the patterns (P)."""
        self.values = wp.array(np.stack([each.values for each in textures]), device=device)
        """Signed distance (P, Y, X) [m]."""
        self.corner = wp.vec2(*first.corner)
        self.step = first.step

    def __len__(self) -> int:
        """Return the number of patterns."""
        return len(self.names)


def textures_of(
    patterns: Sequence[Pattern], body: Body, *, step: float = STEP, device: str = "cpu"
) -> Textures:
    """Return the textures of patterns on a gel.

    Raises:
        SceneError: There is no pattern, or one does not fit on the gel.
    """
    return Textures([distance_texture(each, body, step=step) for each in patterns], device)
