# mypy: ignore-errors
# Holds Warp arrays, typed at run time; mypy cannot follow them.
"""Distance textures of several patterns on one device, read together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from sim.body import Body
from sim.errors import SceneError
from sim.patterns import STEP, DistanceTexture, Markers, distance_texture


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
