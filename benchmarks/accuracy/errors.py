"""Errors of an outcome relative to a reference: force, surface, markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.metrics import Outcome, displacement_at, force_errors, marker_errors
from sim.scene import Body

Array = NDArray[np.float64]

# Points along each side of the grid on which surfaces are compared.
POINTS = 121


@dataclass(frozen=True, slots=True)
class Errors:
    """Differences from the reference, frame by frame (F,); the last frame is the last number."""

    force: Array
    """|F_i - Fref_i| along x, y, z (F, 3) [N]."""
    force_share: Array
    """`force` over max(|Fref| of the frame, `WEAK` of the largest |Fref|) (F, 3)."""
    surface: Array
    """Largest distance between the two positions of a material point of the top (F,) [m]."""
    surface_rms: Array
    """Root of the mean square of that distance (F,) [m]."""
    marker: Array
    """Largest distance between the two images of a marker (F,) [px]."""
    marker_rms: Array
    """Root of the mean square of that distance (F,) [px]."""

    def worst(self) -> dict[str, float]:
        """Return the largest of each over frames and axes; `force_last` is for the last frame."""
        largest = {name: float(getattr(self, name).max()) for name in self.__slots__}
        return largest | {"force_last": float(self.force_share[-1].max())}


def compare(outcome: Outcome, reference: Outcome, body: Body) -> Errors:
    """Return the errors of `outcome` relative to `reference`, for one motion into `body`.

    Surfaces are cubic splines through the points of each, as a rendered image would use. They are
    compared up to the outermost points of the coarser one, where both have points around. The
    spacing of the points may change along the surface.
    """
    force, fraction = force_errors(outcome, reference)
    x = _shared(outcome.surface_x, reference.surface_x)
    y = _shared(outcome.surface_y, reference.surface_y)
    surface = np.empty((len(force), POINTS, POINTS))
    for frame in range(len(force)):
        moved = displacement_at(outcome, frame, x, y) - displacement_at(reference, frame, x, y)
        surface[frame] = np.linalg.norm(moved, axis=-1)
    pixels = marker_errors(outcome, reference, body)
    return Errors(
        force=force,
        force_share=fraction,
        surface=surface.max(axis=(1, 2)),
        surface_rms=np.sqrt(np.mean(surface**2, axis=(1, 2))),
        marker=pixels.max(axis=1),
        marker_rms=np.sqrt(np.mean(pixels**2, axis=1)),
    )


def _shared(one: Array, other: Array) -> Array:
    """Return points (POINTS,) across the range that both cover."""
    return np.linspace(max(one[0], other[0]), min(one[-1], other[-1]), POINTS)
