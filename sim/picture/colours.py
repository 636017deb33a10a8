"""Colour scales of the maps, and the numbers that stand beside them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Scale = tuple[tuple[int, int, int], ...]

HEIGHT: Scale = ((24, 44, 84), (40, 92, 134), (84, 148, 160), (166, 200, 180), (244, 236, 208))
"""Deep is dark blue, high is light sand; evenly spaced, brighter all the way."""
PRESSURE: Scale = ((250, 250, 248), (253, 220, 150), (244, 150, 80), (208, 62, 60), (104, 16, 56))
"""None is paper, the most is dark red; evenly spaced, darker all the way."""


def coloured(share: Array, scale: Scale) -> Array:
    """Colour (..., 3) of each share 0 to 1 of a scale."""
    stops = np.array(scale, float)
    at = np.clip(np.nan_to_num(share), 0, 1) * (len(stops) - 1)
    places = np.arange(len(stops))
    return np.stack([np.interp(at, places, stops[:, band]) for band in range(3)], axis=-1)


def round_numbers(low: float, high: float, about: int) -> list[float]:
    """About so many round numbers within the limits."""
    if not high > low:
        return [low]
    step = round_below(1.5 * (high - low) / about)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(index * step, 12) for index in range(first, last + 1)]


def round_below(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))
