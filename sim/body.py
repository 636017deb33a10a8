"""The soft body: a rectangular elastomer layer bonded to a rigid base, flat or domed on top."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.checks import check_range
from sim.errors import SceneError

Array = NDArray[np.float64]
Places = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Body:
    """A block of soft material whose lower face is bonded to a rigid plate; sides are free.

    Contact frame: the origin is the centre of the untouched top (a dome's apex), z points out of
    the material, so the material fills z from -thickness to 0. Compressible neo-Hookean:
    W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((J^2 - 1)/2 - ln J). Defaults are the paper's gel.

    Raises:
        SceneError: A value outside of what its field allows.
    """

    size_x: float = 20e-3
    """Width along x [m], 1e-4 to 1."""
    size_y: float = 20e-3
    """Width along y [m], 1e-4 to 1."""
    thickness: float = 4e-3
    """Height from the base to the top (to the apex, with a dome) [m], 1e-4 to 1."""
    modulus: float = 0.145e6
    """Young's modulus at rest, after all relaxation [Pa], 1e2 to 1e9."""
    poisson: float = 0.45
    """Poisson's ratio at rest, 0 to 0.49995; 0.5 (incompressible) is not solved."""
    dome_radius: float | None = None
    """Radius of a spherical top [m]; None is flat. The dome must stay above half the thickness
    at the corners."""
    density: float = 1070.0
    """Mass per volume [kg/m^3], 1 to 1e5; only inertia and gravity use it."""

    def __post_init__(self) -> None:
        for name in ("size_x", "size_y", "thickness"):
            check_range("body", name, getattr(self, name), 1e-4, 1.0, unit="m")
        check_range("body", "modulus", self.modulus, 1e2, 1e9, unit="Pa")
        check_range("body", "poisson", self.poisson, 0.0, 0.49995)
        check_range("body", "density", self.density, 1.0, 1e5, unit="kg/m^3")
        if self.dome_radius is not None:
            corner = math.hypot(self.size_x, self.size_y) / 2
            check_range("body", "dome_radius", self.dome_radius, corner, 1e3, unit="m")
            if self.height(self.size_x / 2, self.size_y / 2) < -self.thickness / 2:
                raise SceneError(
                    f"body.dome_radius: {self.dome_radius!r} m; the corners would lie deeper than "
                    f"half the thickness; allowed: a larger radius, or a smaller body"
                )

    @property
    def shear_modulus(self) -> float:
        """G = E / (2 (1 + nu)) [Pa]."""
        return self.modulus / (2 * (1 + self.poisson))

    @property
    def bulk_modulus(self) -> float:
        """K = E / (3 (1 - 2 nu)) [Pa]."""
        return self.modulus / (3 * (1 - 2 * self.poisson))

    def height(self, x: float, y: float) -> float:
        """Height of the untouched top at (x, y) [m]: 0 when flat, below 0 off a dome's apex."""
        return float(self.heights(np.array([x]), np.array([y]))[0, 0])

    def heights(self, x: Places, y: Places) -> Array:
        """Heights of the untouched top at all places of a raster, x (X,) and y (Y,): (X, Y) [m]."""
        if self.dome_radius is None:
            return np.zeros((len(x), len(y)))
        square = self.dome_radius**2 - np.square(x)[:, None] - np.square(y)
        return np.asarray(np.sqrt(square) - self.dome_radius)
