# mypy: ignore-errors
# Holds Warp arrays, typed at run time; mypy cannot follow them.
"""What the camera sees of a gel, before any pattern: the material point at each pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recorder.markers import unpack
from sim.render.sampling import coverages, packed_masks
from sim.render.textures import Textures


class View:
    """F frames as a camera sees them; any pattern can be looked at."""

    def __init__(self, material, samples: int) -> None:
        """Hold `material`, x and y [m] at `samples` x `samples` samples a pixel (F, H, W)."""
        self._material, self._samples = material, samples

    def __len__(self) -> int:
        """Number of frames."""
        return self._material.shape[0]

    def material(self) -> NDArray[np.float32]:
        """Untouched place, x and y [m], of what each sample sees (F, H, W, 2).

        NaN where there is no gel. H and W are 480 and 640 times the samples along a pixel's side.
        """
        return self._material.numpy()

    def packed(self, textures: Textures) -> NDArray[np.uint8]:
        """Masks of every frame and pattern as packed bits (F, P, 38400)."""
        return packed_masks(self._material, self._samples, textures).numpy()

    def masks(self, textures: Textures) -> NDArray[np.bool_]:
        """The same (F, P, 480, 640): True where a marker covers at least half of a pixel."""
        return unpack(self.packed(textures))

    def coverage(self, textures: Textures) -> NDArray[np.uint8]:
        """Share of each pixel that markers cover, 255 for all of it (F, P, 480, 640)."""
        return coverages(self._material, self._samples, textures).numpy()
