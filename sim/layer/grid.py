"""Where the layer is sampled: pixels across the body, and the period its waves repeat with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sim.body import Body
from sim.errors import SceneError
from sim.layer.compliance import Compliance, compliance

Array = NDArray[np.floating[Any]]

MARGIN = 5.0
"""Thicknesses that are added to twice the body's size before its waves repeat. Against waves that
never repeat, forces are 0.005 % off at most on the default body and 0.06 % on one as thick as wide
(contacts to two thirds of the body's width, nu to 0.5)."""
THICKNESS_MAX = 2.0
"""Thickest body over its narrower side: the model knows no sides, and the period grows with it."""


@dataclass(frozen=True)
class Grid:
    """Pixels across the top of a body: (nx, ny) of about equal width.

    Tractions and displacements are sampled at the pixels' centres and carry every wave that the
    pixels can hold and none beyond (a pixel is a sinc). Against averaging over pixels on one side
    or both, this is the choice whose force has no bias.
    """

    body: Body
    count: int
    """Pixels along the longer side."""

    def __post_init__(self) -> None:
        limit = THICKNESS_MAX * min(self.body.size_x, self.body.size_y)
        if self.body.thickness > limit:
            raise SceneError(
                f"body.thickness: {self.body.thickness!r} m; allowed with tier 'layer': up to "
                f"{limit:g} m, {THICKNESS_MAX:g} times the narrower side (it knows no sides; 'fem' "
                "does)"
            )
        if not 16 <= self.count <= 512:
            raise SceneError(f"grid: {self.count!r}; allowed: 16 to 512")

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Pixels along x and along y."""
        longer = max(self.body.size_x, self.body.size_y)
        x, y = (
            max(1, round(self.count * size / longer))
            for size in (self.body.size_x, self.body.size_y)
        )
        return x, y

    @cached_property
    def pixel(self) -> tuple[float, float]:
        """Width of a pixel along x and along y [m]."""
        return self.body.size_x / self.shape[0], self.body.size_y / self.shape[1]

    @property
    def area(self) -> float:
        """Area of a pixel [m^2]."""
        return self.pixel[0] * self.pixel[1]

    @cached_property
    def x(self) -> Array:
        """Centres of the pixels along x (nx,) [m]."""
        return (np.arange(self.shape[0]) + 0.5) * self.pixel[0] - self.body.size_x / 2

    @cached_property
    def y(self) -> Array:
        """Centres of the pixels along y (ny,) [m]."""
        return (np.arange(self.shape[1]) + 0.5) * self.pixel[1] - self.body.size_y / 2

    @cached_property
    def period(self) -> tuple[int, int]:
        """Pixels after which the waves repeat, along x and along y; even."""
        sizes = (self.body.size_x, self.body.size_y)
        x, y = (
            2
            * scipy.fft.next_fast_len(
                int(np.ceil((2 * size + MARGIN * self.body.thickness) / pixel / 2)), real=True
            )
            for size, pixel in zip(sizes, self.pixel, strict=True)
        )
        return x, y

    @cached_property
    def symbol(self) -> Array:
        """The layer's compliance for every wave of the period (6, px, py // 2 + 1) [m/Pa].

        Rows: xx, yy, zz, xy, and xz, yz divided by i. zx = -xz and zy = -yz (both over i); the rest
        is symmetric.
        """
        kx = 2 * np.pi * np.fft.fftfreq(self.period[0], self.pixel[0])[:, None]
        ky = 2 * np.pi * np.fft.rfftfreq(self.period[1], self.pixel[1])[None, :]
        length = np.hypot(kx, ky)
        layer = self._compliance(length)
        unit = np.where(length == 0, 1.0, length)
        cosine, sine = np.where(length == 0, 1.0, kx / unit), ky / unit
        mixed = (layer.from_along - layer.from_across) * cosine * sine
        symbol = np.stack(
            [
                layer.from_along * cosine**2 + layer.from_across * sine**2,
                layer.from_along * sine**2 + layer.from_across * cosine**2,
                layer.from_normal,
                mixed,
                layer.coupling * cosine,
                layer.coupling * sine,
            ]
        )
        # The shortest wave has no odd part that samples could hold (the transform knows, along y).
        symbol[3:, self.period[0] // 2, :] = 0
        return symbol

    def _compliance(self, length: Array) -> Compliance:
        # A square period has each wave number eight times over.
        numbers, index = np.unique(length, return_inverse=True)
        layer = compliance(
            numbers,
            thickness=self.body.thickness,
            shear_modulus=self.body.shear_modulus,
            poisson=self.body.poisson,
        )
        index = index.reshape(length.shape)
        return Compliance(*(getattr(layer, name)[index] for name in Compliance.__slots__))
