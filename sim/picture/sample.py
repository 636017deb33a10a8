"""The deformed surface from above: what lies at each place now, not what lay there before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates

from sim.result import Result

Array = NDArray[np.float64]

FINE = 200
"""Points along each side that the surface is refined to, at least, before it is drawn."""
ROUNDS, RELAXATION = 40, 0.7
"""Rounds of the search for what moved to a place, and the share of the miss that each makes up
for: converges unless the surface folds over or is stretched to more than 2.8 times its length."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Height and pressure over the place where the material is now."""

    half_x: float
    """Half the width of what there is to see [m]."""
    half_y: float
    """The same along y [m]."""
    pressure_max: float
    """Largest pressure of the result itself, before any refinement [Pa]."""
    _corner: Array
    """Least x and y of the untouched points (2,) [m]."""
    _spacing: Array
    """Distance between them along x and y (2,) [m]."""
    _fields: Array
    """Sideways shift (2), height and pressure of each point (4, X, Y)."""
    _overhang: Array
    """How far the body reaches beyond its outermost points (2,) [m]."""

    def at(self, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
        """Height above the untouched apex [m] and pressure [Pa] at x, y (broadcast together).

        NaN beside the body.
        """
        shape = np.broadcast_shapes(np.shape(x), np.shape(y))
        place = np.stack([np.broadcast_to(axis, shape).ravel() for axis in (x, y)])
        origin = place.astype(np.float64)
        if self._fields[:2].any():
            for _ in range(ROUNDS):
                shift = np.stack([self._look(axis, origin) for axis in (0, 1)])
                origin += RELAXATION * (place - shift - origin)
        reach = self._half + self._overhang
        middle = self._corner + self._half
        outside = (np.abs(origin - middle[:, None]) > reach[:, None]).any(axis=0)
        height, pressure = (np.where(outside, np.nan, self._look(one, origin)) for one in (2, 3))
        pressure = np.clip(pressure, 0.0, self.pressure_max)
        return height.reshape(shape), pressure.reshape(shape)

    @property
    def _half(self) -> Array:
        return np.asarray(self._spacing * (np.array(self._fields.shape[1:]) - 1) / 2)

    def _look(self, field: int, origin: Array) -> Array:
        """A field at untouched places (2, N): (N,), that of the rim beyond it."""
        index = (origin - self._corner[:, None]) / self._spacing[:, None]
        found: Array = map_coordinates(self._fields[field], index, order=1, mode="nearest")
        return found


def surface_of(result: Result, frame: int) -> Surface:
    """The surface of one frame, refined so that a coarse mesh looks smooth.

    The `layer` tier, linear as it is, looks for contact where the material was untouched: its
    points are drawn there.
    """
    x, y = result.surface_x, result.surface_y
    body = result.scene.body
    fine_x, fine_y = _refined(x), _refined(y)
    moved = _values_between(x, y, result.surface[frame], fine_x, fine_y)
    traction = np.nan_to_num(result.traction[frame, :, :, 2].astype(np.float64))
    pressure = np.maximum(-traction, 0.0)
    rest = body.heights(fine_x, fine_y)
    shift = moved[..., :2] * (result.tier != "layer")
    drawn = _values_between(x, y, pressure, fine_x, fine_y)
    place = np.stack(np.meshgrid(fine_x, fine_y, indexing="ij"), axis=-1) + shift
    reach = np.abs(place).max(axis=(0, 1))
    half = np.array([body.size_x, body.size_y]) / 2
    return Surface(
        half_x=max(float(half[0]), float(reach[0])),
        half_y=max(float(half[1]), float(reach[1])),
        pressure_max=float(pressure.max()),
        _corner=np.array([x[0], y[0]]),
        _spacing=np.array([fine_x[1] - fine_x[0], fine_y[1] - fine_y[0]]),
        _fields=np.stack([*np.moveaxis(shift, -1, 0), rest + moved[..., 2], drawn]),
        _overhang=half - (x[-1], y[-1]),
    )


def _refined(along: Array) -> Array:
    """Evenly spaced `along` with as many points between as make at least `FINE` of them."""
    between = -(-FINE // (len(along) - 1))
    return np.linspace(along[0], along[-1], between * (len(along) - 1) + 1)


def _values_between(x: Array, y: Array, values: ArrayLike, fine_x: Array, fine_y: Array) -> Array:
    """Values (X, Y, ...) at finer places, by cubics that never overshoot their neighbours.

    A spline would swing around the rim of a contact and draw ripples that nobody computed.
    """
    given = np.asarray(values, np.float64)
    along_x = PchipInterpolator(x, given, axis=0)(fine_x)
    refined: Array = PchipInterpolator(y, along_x, axis=1)(fine_y)
    return refined
