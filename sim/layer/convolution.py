"""What tractions on the layer's top do to it: convolutions, as large as they need to be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import DTypeLike, NDArray

from sim.layer.grid import Grid

Array = NDArray[np.floating[Any]]
Spectrum = NDArray[np.complexfloating[Any, Any]]

SHAPES_KEPT = 64
"""Shapes of windows that are kept before all are made anew; each takes a megabyte or so."""


class Convolution:
    """Displacement of pixels by tractions on them [m], [Pa]; fields are (3, X, Y)."""

    def __init__(
        self,
        spectrum: Array,
        shape: tuple[int, int],
        padded: tuple[int, int],
        dtype: DTypeLike = np.float64,
    ) -> None:
        """Take the answer wave by wave, laid out as `Grid.symbol`, for waves over `padded` pixels.

        `shape` is the field's; beyond it, up to `padded`, there is no traction.
        """
        self._shape, self._padded = shape, padded
        parts = spectrum.astype(dtype)
        self._xx, self._yy, self._zz, self._xy = parts[:4]
        self._xz, self._yz = 1j * parts[4:]

    def normal(self, traction: Array) -> Array:
        """Normal displacement (X, Y) by a normal traction (X, Y)."""
        return self._back(self._zz * self._forward(traction))

    def shear(self, traction: Array) -> Array:
        """In-plane displacement (2, X, Y) by an in-plane traction (2, X, Y)."""
        x, y = self._forward(traction)
        return self._back(np.stack([self._xx * x + self._xy * y, self._xy * x + self._yy * y]))

    def shear_by_normal(self, traction: Array) -> Array:
        """In-plane displacement (2, X, Y) by a normal traction (X, Y)."""
        z = self._forward(traction)
        return self._back(np.stack([self._xz * z, self._yz * z]))

    def normal_by_shear(self, traction: Array) -> Array:
        """Normal displacement (X, Y) by an in-plane traction (2, X, Y)."""
        x, y = self._forward(traction)
        return self._back(-self._xz * x - self._yz * y)

    def full(self, traction: Array) -> Array:
        """Displacement (3, X, Y) by a traction (3, X, Y)."""
        x, y, z = self._forward(traction)
        return self._back(
            np.stack(
                [
                    self._xx * x + self._xy * y + self._xz * z,
                    self._xy * x + self._yy * y + self._yz * z,
                    self._zz * z - self._xz * x - self._yz * y,
                ]
            )
        )

    def _forward(self, field: Array) -> Spectrum:
        # One axis at a time: rows of nothing but padding are not transformed.
        half = scipy.fft.rfft(field, n=self._padded[1], axis=-1)
        spectrum: Spectrum = scipy.fft.fft(half, n=self._padded[0], axis=-2, overwrite_x=True)
        return spectrum

    def _back(self, spectrum: Spectrum) -> Array:
        half = scipy.fft.ifft(spectrum, axis=-2, overwrite_x=True)[..., : self._shape[0], :]
        field: Array = scipy.fft.irfft(half, n=self._padded[1], axis=-1)[..., : self._shape[1]]
        return field


@dataclass(frozen=True, slots=True)
class Elastic:
    """The layer under a window, as contact sees it."""

    answer: Convolution
    local_normal: float
    """Normal displacement of a pixel by a normal traction on it alone [m/Pa]."""
    local_shear: float
    """The same in the plane."""


class Convolutions:
    """The whole top's convolution, and smaller ones for windows that hold the contact."""

    def __init__(self, grid: Grid, dtype: DTypeLike = np.float64) -> None:
        """Transform the grid's symbol to the answer to one loaded pixel; `dtype` is a window's."""
        self.dtype = np.dtype(dtype)
        symbol = grid.symbol
        waves = np.concatenate([symbol[:4], 1j * symbol[4:]])
        self._kernel = scipy.fft.irfft2(waves, s=grid.period)
        self.whole = self._cut(grid.shape, np.float32)
        """Over all pixels, in single precision: for what is shown, not for what is solved."""
        self._made: dict[tuple[int, ...], Elastic] = {}

    def within(self, shape: tuple[int, ...]) -> Elastic:
        """The layer within a window of `shape`, made once for each shape."""
        if shape not in self._made:
            if len(self._made) == SHAPES_KEPT:
                self._made.clear()
            local = self._kernel[:3, 0, 0]
            self._made[shape] = Elastic(
                self._cut(shape, self.dtype), float(local[2]), float(min(local[0], local[1]))
            )
        return self._made[shape]

    def _cut(self, shape: tuple[int, ...], dtype: DTypeLike) -> Convolution:
        """The convolution over a window of `shape`, without the period's images.

        Padded to twice the window, it meets the kernel at true distances only, so the margin
        around the body costs it nothing.
        """
        padded = [scipy.fft.next_fast_len(2 * size - 1, real=True) for size in shape]
        reach = [np.r_[0:size, 1 - size : 0] for size in shape]
        slots = [index % size for index, size in zip(reach, padded, strict=True)]
        kernel = np.zeros((6, *padded))
        kernel[(slice(None), *np.ix_(*slots))] = self._kernel[(slice(None), *np.ix_(*reach))]
        spectrum = scipy.fft.rfft2(kernel)
        parts = np.concatenate([spectrum[:4].real, spectrum[4:].imag])
        return Convolution(parts, (shape[0], shape[1]), (padded[0], padded[1]), dtype)
