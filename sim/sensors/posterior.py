"""Uncertainty of a sensor identified from its own presses."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError, check_range
from sim.result import ContactTier

# Quantities of a sensor that presses may identify; branches of viscosity are numbered from 1.
_NAMES = re.compile(r"modulus|thickness|poisson|friction|ratio_[1-4]|time_[1-4]")
# Quantities of a camera that images may identify.
CAMERA = (
    *("scale", "distance", "shift_x", "shift_y", "rotation"),
    *("camera_tilt_x", "camera_tilt_y"),
)
# Quantities that are distributed by their logarithms, without their numbers; others as they are.
LOGARITHMS = ("modulus", "thickness", "friction", "ratio", "time", "scale", "distance")


@dataclass(frozen=True, slots=True)
class Posterior:
    """Normal distribution of a sensor's quantities about the values of its row.

    All are in logarithms, so that a spread of 0.02 is 2 %, but Poisson's ratio and the shift [px]
    and rotation [rad] of the image and the camera's tilt [rad] are as they are.

    Raises:
        SceneError: A name is unknown or repeated, or a shape or a value does not fit.
    """

    names: tuple[str, ...]
    """modulus, thickness, poisson, friction, ratio_1, time_1 and so on, and those of `CAMERA`."""
    spreads: tuple[float, ...]
    """Standard deviation of each."""
    correlations: tuple[tuple[float, ...], ...]
    """Matrix of correlations, -1 to 1, with ones on its diagonal."""
    tier: ContactTier = field(default="layer", repr=False, metadata={"stored": "unless default"})
    """Tier whose forces the quantities explain: by the other they give other forces."""
    height: float = field(
        default=0.0, repr=False, metadata={"unit": "um", "stored": "unless default"}
    )
    """Height of the surface over where the presses of the fit have it [m], -1e-3 to 1e-3. Found
    along with the quantities, it belongs to them: without it they give other forces."""
    law: float = field(default=0.0, repr=False, metadata={"stored": "unless default"})
    """Error of forces at rest that no quantity explains, 0 to 1: standard deviation along an axis
    over the whole force. It is of the fitted presses, and includes errors of the grid."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.names if name not in CAMERA and not _NAMES.fullmatch(name)]
        if unknown or len(set(self.names)) != len(self.names):
            raise SceneError(
                f"posterior.names: {', '.join(unknown or self.names)}; allowed: modulus, "
                "thickness, poisson, friction, ratio_1 to ratio_4, time_1 to time_4, "
                f"{', '.join(CAMERA)}, each once"
            )
        count = len(self.names)
        check_range("posterior", "height", self.height, -1e-3, 1e-3, unit="m")
        check_range("posterior", "law", self.law, 0.0, 1.0)
        matrix = np.array(self.correlations, float) if self.correlations else np.zeros((0, 0))
        if len(self.spreads) != count or matrix.shape != (count, count):
            raise SceneError(
                f"posterior: {count} names, {len(self.spreads)} spreads, correlations of shape "
                f"{matrix.shape}; allowed: one spread for each name, and a square of that size"
            )
        for name, spread in zip(self.names, self.spreads, strict=True):
            most = 100.0 if name.startswith("shift") else 3.0
            check_range("posterior.spreads", name, spread, 0.0, most)
        if not np.allclose(matrix, matrix.T, atol=1e-6) or np.abs(matrix).max(initial=0) > 1.000001:
            raise SceneError("posterior.correlations: allowed: a symmetric matrix, -1 to 1")

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        covariance: NDArray[np.float64],
        tier: ContactTier = "layer",
        height: float = 0.0,
        law: float = 0.0,
    ) -> Self:
        """Return the distribution with a covariance (p, p)."""
        spread = np.sqrt(np.diag(covariance))
        matrix = np.clip(covariance / np.outer(spread, spread), -1.0, 1.0)
        np.fill_diagonal(matrix, 1.0)
        correlations = tuple(map(tuple, matrix.tolist()))
        spreads = tuple(spread.tolist())
        return cls(tuple(names), spreads, correlations, tier, float(height), float(law))


# Of a sensor whose quantities are certain.
CERTAIN = Posterior((), (), ())


def is_log(name: str) -> bool:
    """Return True if a quantity is distributed, and fitted, by its logarithm."""
    return name.partition("_")[0] in LOGARITHMS


def interval_of(name: str, value: float, spread: float) -> tuple[float, float]:
    """Return the interval of a quantity, `spread` to both sides of it or of its logarithm."""
    if is_log(name):
        return value * math.exp(-spread), value * math.exp(spread)
    return value - spread, value + spread
