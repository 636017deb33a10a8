"""Material priors: compression of one sensor over depth as polynomials, loading and unloading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.compensation.curves import ForceDepth
from learning.errors import LearningError
from learning.genforce.coefficients import Compensation
from recorder import PHASES

Floats = NDArray[np.float64]

DEGREE = 2
"""Of the polynomials that are fitted (the paper, Results, material softness)."""
LOADING = (PHASES.index("normal_inc"), PHASES.index("shear_inc"))
"""Phases that take the loading curve; the two others take the unloading one (authors' code)."""


@dataclass(frozen=True, slots=True)
class Branch:
    """Compression over depth in one direction."""

    coefficients: tuple[float, ...]
    """Of the share of the depth range, highest power first [N]."""
    residual: float | None = None
    """Root mean square of what the fit leaves over [N]; None where nothing was fitted."""
    samples: int = 0
    """Number of forces that were fitted."""

    def compression(self, share: Floats) -> Floats:
        """Return the compression (n,) [N] at shares of the depth range (n,)."""
        return np.asarray(np.polyval(self.coefficients, share), np.float64)


@dataclass(frozen=True, slots=True)
class Prior:
    """How hard one sensor is, as far as a flat indenter can tell."""

    sensor: str
    loading: Branch
    unloading: Branch
    depth_range: float
    """Depth that counts as 1 [m]. Two sensors are compared at the same share of their ranges,
    which is the same depth where the ranges are equal (the paper, Methods: heterogeneous)."""
    depth_max: float
    """Deepest that was measured [m]; beyond it nothing is foretold."""
    indenter: str = ""
    source: str = ""
    """Where it was measured, in words."""

    def __post_init__(self) -> None:
        """Refuse a prior that says nothing."""
        for name in ("depth_range", "depth_max"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise LearningError(
                    f"prior {self.sensor}.{name}: found {value} m; allowed: above 0"
                )
        for name in ("loading", "unloading"):
            found = getattr(self, name).coefficients
            if not found or not np.isfinite(found).all():
                raise LearningError(
                    f"prior {self.sensor}.{name}: found {found}; allowed: finite coefficients"
                )

    @property
    def share_max(self) -> float:
        """Deepest share of the range that was measured."""
        return self.depth_max / self.depth_range

    def branch(self, loading: bool) -> Branch:
        """Return the curve of one direction."""
        return self.loading if loading else self.unloading


def fit_prior(measured: ForceDepth, depth_range: float | None = None) -> Prior:
    """Return the polynomials of degree 2 through what was measured, least squares.

    Args:
        measured: Forces over depth.
        depth_range: Depth that counts as 1 [m]; the deepest measured one when None.

    Raises:
        LearningError: NaN, too few different depths to fit, or a sensor that does not push back.
    """
    reach = measured.depth_max if len(measured.loading) and len(measured.unloading) else np.nan
    span = reach if depth_range is None else depth_range
    return Prior(
        measured.sensor,
        _fitted(measured.sensor, "loading", measured.loading, span),
        _fitted(measured.sensor, "unloading", measured.unloading, span),
        span,
        reach,
        indenter=measured.indenter,
        source=measured.source,
    )


def prior_of_coefficients(
    sensor: str, known: Compensation, *, depth_range: float, per_mm: bool, source: str
) -> Prior:
    """Return the prior that published coefficients stand for.

    Forces below 0 at the end of the range are taken for a gauge whose compression is negative.

    Args:
        sensor: Name of the sensor.
        known: Polynomials for loading and unloading, highest power first.
        depth_range: Depth that counts as 1 [m].
        per_mm: Whether they are of depth in mm (material test); else of its share of the range
            (heterogeneous test).
        source: Where they are from, in words.

    Raises:
        LearningError: Coefficients that are no numbers, or a range that is none.
    """
    unit = depth_range * 1e3 if per_mm else 1.0
    loading, unloading = _converted(known.down, unit), _converted(known.up, unit)
    return Prior(sensor, loading, unloading, depth_range, depth_range, source=source)


def _converted(values: tuple[float, ...], unit: float) -> Branch:
    """Return a polynomial of depth in units of which the range has `unit`, as one of the share."""
    powers = np.arange(len(values) - 1, -1, -1)
    coefficients = np.asarray(values, np.float64) * unit**powers
    sign = -1.0 if coefficients.sum() < 0 else 1.0
    return Branch(tuple(float(value) for value in sign * coefficients))


def _fitted(sensor: str, name: str, pairs: Floats, span: float) -> Branch:
    where = f"prior {sensor}.{name}"
    if not np.isfinite(pairs).all():
        raise LearningError(f"{where}: found NaN or infinity; allowed: numbers")
    depths = len(np.unique(pairs[:, 0].round(9))) if len(pairs) else 0
    if depths <= DEGREE:
        raise LearningError(
            f"{where}: found forces at {depths} depths; allowed: {DEGREE + 1} or more"
        )
    share, force = pairs[:, 0] / span, pairs[:, 1]
    powers = np.vander(share, DEGREE + 1)
    coefficients = np.linalg.lstsq(powers, force, rcond=None)[0]
    residual = float(np.sqrt(np.mean((powers @ coefficients - force) ** 2)))
    deepest = force[share >= np.quantile(share, 0.9)].mean()
    if not deepest > 0:
        raise LearningError(
            f"{where}: found {deepest:.3g} N of compression at its deepest; allowed: above 0 "
            "(compression is negative Fz)"
        )
    return Branch(tuple(float(value) for value in coefficients), residual, len(pairs))
