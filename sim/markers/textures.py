# mypy: ignore-errors
# Holds Warp arrays, typed at run time; mypy cannot follow them.
"""What rendering sees of any pattern: its signed distance, sampled over the gel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.errors import SceneError, check_range
from sim.scene import Body

Array = NDArray[np.float64]

# Between samples [m]: with it the edge of a disc of 0.25 mm radius is 0.2 um off at most.
STEP = 20e-6
# How far from a marker the distance is told [m]; several pixels of every camera in use.
BAND = 0.25e-3


class Markers(Protocol):
    """What can be drawn on a gel."""

    @property
    def name(self) -> str:
        """What to call it."""

    def distance(self, x: Array, y: Array, band: float) -> Array:
        """Signed distance (Y, X) [m] at rising x (X,) and y (Y,), negative inside a marker."""

    def check_within(self, body: Body) -> None:
        """Refuse a gel that the markers do not fit on."""


@dataclass(frozen=True, slots=True, eq=False)
class DistanceTexture:
    """Signed distance to the nearest edge of a marker; bilinear in between, negative inside."""

    name: str
    values: NDArray[np.float32]
    """(Y, X) [m]; x along the second axis, y upwards along the first."""
    corner: tuple[float, float]
    """x and y of the first value [m]."""
    step: float
    """Distance of neighbours [m]."""


def distance_texture(markers: Markers, body: Body, *, step: float = STEP) -> DistanceTexture:
    """The texture of a pattern over the whole top of a gel.

    Raises:
        SceneError: A marker beyond the gel's border, or a step out of range.
    """
    check_range("texture", "step", step, 1e-6, 1e-3, unit="m")
    markers.check_within(body)
    x, y = (_samples(size, step) for size in (body.size_x, body.size_y))
    values = markers.distance(x, y, max(BAND, 2 * step))
    if body.footprint != "rectangle":
        values = np.maximum(values, -body.from_side(x, y[:, None]))  # cut off beside the gel
    values = values.astype(np.float32)
    return DistanceTexture(markers.name, values, (float(x[0]), float(y[0])), step)


def _samples(size: float, step: float) -> Array:
    """Places about 0 that cover `size`."""
    count = math.ceil(size / step - 1e-9) + 1
    return np.asarray((np.arange(count) - (count - 1) / 2) * step)


# Distance textures of several patterns on one device, read together.


class Textures:
    """P patterns of one gel, ready to be sampled."""

    def __init__(self, textures: Sequence[DistanceTexture], device: str) -> None:
        """Copy them to the device.

        Raises:
            SceneError: None, or some that differ in size or place.
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
        """What they are called (P)."""
        self.values = wp.array(np.stack([each.values for each in textures]), device=device)
        """Signed distance (P, Y, X) [m]."""
        self.corner = wp.vec2(*first.corner)
        self.step = first.step

    def __len__(self) -> int:
        """Number of patterns."""
        return len(self.names)


def textures_of(
    markers: Sequence[Markers], body: Body, *, step: float = STEP, device: str = "cpu"
) -> Textures:
    """Textures of patterns on a gel.

    Raises:
        SceneError: No pattern, or one that does not fit on the gel.
    """
    return Textures([distance_texture(each, body, step=step) for each in markers], device)
