"""Meshes graded to the contact: fine at the indenter, coarser outwards and downwards."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.independent.element import Grid

Array = NDArray[np.float64]

# Number of points at which the element size is integrated.
SAMPLES = 20_000


class Fine(NamedTuple):
    """Interval with elements of one size, in the unit of the mesh."""

    low: float
    high: float
    size: float


def graded(low: float, high: float, places: Sequence[Fine], growth: float, largest: float) -> Array:
    """Return lines from `low` to `high` [m] between elements of the sizes given by `places`.

    Away from these intervals elements grow by `growth` per distance, up to `largest` [m].
    """
    # Half of the samples are dense at either end, where elements may be 1e-4 of the whole.
    fraction = np.linspace(0, 1, SAMPLES) ** 3
    x = np.unique(np.concatenate([low + (high - low) * fraction, high - (high - low) * fraction]))
    middle = (x[1:] + x[:-1]) / 2
    size = np.full_like(middle, largest)
    for place in places:
        away = np.maximum(np.maximum(place.low - middle, middle - place.high), 0.0)
        size = np.minimum(size, place.size + growth * away)
    count = np.concatenate([[0.0], np.cumsum(np.diff(x) / size)])
    whole = max(2, int(np.ceil(count[-1])))
    return np.asarray(np.interp(np.linspace(0, count[-1], whole + 1), count, x))


def layer_grid(
    radius: float,
    thickness: float,
    places: Sequence[Fine],
    growth: float = 0.3,
    dome: float | None = None,
) -> Grid:
    """Return the mesh of a layer [m] whose elements at the top have the sizes in `places`.

    With a `dome` [m], the top is a sphere of that radius, `thickness` high at the middle.
    """
    finest = min(place.size for place in places)
    r = graded(0.0, radius, places, growth, thickness / 2)
    z = -graded(0.0, thickness, [Fine(0.0, 0.0, finest)], growth, thickness / 5)[::-1]
    return Grid(r, z, dome)
