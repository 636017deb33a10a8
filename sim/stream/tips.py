"""Tips of pins, quickly: what `Pins.tips` finds on a fine grid of the skin, at the pins alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim.sensors import Pins
from sim.sensors.field import EVEN_STEP, cubic_weights

Array = NDArray[np.float64]

NODES = (-math.sqrt(3.0), 0.0, math.sqrt(3.0))
"""Places along an axis whose weighted mean is a Gaussian's, in its standard deviations: exact for
polynomials up to the fifth degree (Gauss and Hermite's rule of three)."""
SHARES = np.array([1.0, 4.0, 1.0]) / 6.0


class LiveTips:
    """Displacement of the tips of some pins, from that of the skin.

    Args:
        pins: The pins.
        x: Of the points of the skin (X,) [m], rising.
        y: The same (Y,).
        centres: Where the pins are (n, 2) [m].
    """

    def __init__(self, pins: Pins, x: Array, y: Array, centres: Array) -> None:
        self._length = pins.length
        self._x, self._slope_x = _weights(x, centres[:, 0], pins.base)
        self._y, self._slope_y = _weights(y, centres[:, 1], pins.base)

    def displacement(self, skin: NDArray[np.float32]) -> Array:
        """Of the tips (n, 3) [m]; `skin` is the displacement (X, Y, 3) [m]."""
        rows, columns, _ = skin.shape
        flat = skin.reshape(rows, columns * 3).astype(float)
        pins, nodes = len(self._x) // len(NODES), len(NODES)

        def at(along_x: Array, along_y: Array) -> Array:
            """Values at each pin's nodes (n, nodes, nodes, 3)."""
            lines = (along_x @ flat).reshape(pins, nodes, columns, 3)
            crossed = np.matmul(along_y.reshape(pins, 1, nodes, columns), lines)
            return np.asarray(crossed)

        tangent_x = at(self._slope_x, self._y) + np.array([1.0, 0.0, 0.0])
        tangent_y = at(self._x, self._slope_y) + np.array([0.0, 1.0, 0.0])
        normal = np.cross(tangent_x, tangent_y)
        normal = _averaged(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        moved = _averaged(at(self._x, self._y))
        tips: Array = moved + self._length * (np.array([0.0, 0.0, 1.0]) - normal)
        return tips


def _averaged(values: Array) -> Array:
    """Means (n, 3) over the feet of values at their nodes (n, nodes, nodes, 3)."""
    mean: Array = np.einsum("nabc,a,b->nc", values, SHARES, SHARES)
    return mean


def _weights(known: Array, centres: Array, base: float) -> tuple[Array, Array]:
    """Weights (n * nodes, K) of values at `known` (K,) in the value at each node, and its slope."""
    count = max(2, round((known[-1] - known[0]) / EVEN_STEP) + 1)
    even = np.linspace(known[0], known[-1], count)
    fine = cubic_weights(known, even)
    # The spread of a disc along an axis is a quarter of its width.
    nodes = (centres[:, None] + base / 4 * np.array(NODES)).ravel()
    to_nodes = cubic_weights(even, nodes)
    return to_nodes @ fine, to_nodes @ np.gradient(fine, even[1] - even[0], axis=0)
