"""Material priors: polynomials of a sensor's compression over depth, loading and unloading."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.data.genforce.format import Compensation
from learning.errors import LearningError
from recorder.session import Session, press_curves
from recorder.spec import PHASES

# Measured force over depth: rows of an archive, or a session of `rig force-depth`.

Floats = NDArray[np.float64]
Table = Mapping[str, np.ndarray[Any, Any]]

DOWN, UP = PHASES.index("normal_inc"), PHASES.index("normal_dec")
# The flat, rigid indenter of the paper's material test (the paper, Methods).
INDENTER = "prism"


@dataclass(frozen=True, slots=True, eq=False)
class ForceDepthCurve:
    """Force over depth of one sensor; all repeats combined."""

    sensor: str
    indenter: str
    source: str
    """Description of the measurement."""
    loading: Floats
    """Depth [m] and compression [N] during loading (n, 2)."""
    unloading: Floats
    """The same during unloading (m, 2)."""

    @property
    def depth_max(self) -> float:
        """Deepest depth [m]."""
        return float(max(self.loading[:, 0].max(), self.unloading[:, 0].max()))


def curve_of_table(sensor: str, table: Table, indenters: Sequence[str]) -> ForceDepthCurve | None:
    """Return the curve from force-depth rows of an archive's table; None without labelled ones.

    Such rows have location -1 and the phase `normal_inc` or `normal_dec`. Rows that are invalid or
    without contact (depth 0) are ignored.
    """
    phase = table["phase"]
    rows = (table["location"] < 0) & table["valid"] & np.isin(phase, (DOWN, UP))
    force = -table["wrench"][:, 2]
    if not (rows & np.isfinite(force)).any():
        return None
    indenter = _indenter(sensor, table, rows, indenters)
    rows &= (table["indenter"] == indenters.index(indenter)) & (table["depth"] > 0)
    unknown = np.flatnonzero(rows & ~np.isfinite(force))
    if unknown.size:
        raise LearningError(
            f"{sensor}.wrench: found NaN in row {unknown[0]} (and {unknown.size - 1} more) of the "
            "force-depth presses; allowed: numbers"
        )
    pairs = np.stack([table["depth"], force], axis=1)
    presses = len(np.unique(table["target"][rows]))
    return ForceDepthCurve(
        sensor,
        indenter,
        f"{presses} force-depth presses of the archive",
        pairs[rows & (phase == DOWN)],
        pairs[rows & (phase == UP)],
    )


def curve_of_session(path: Path) -> ForceDepthCurve:
    """Return the curve from a session of `tactile force-depth`."""
    session = Session(path)
    curves = press_curves(session)
    names = [session.attrs.get(name) for name in ("sensor", "indenter")]
    if not all(isinstance(name, str) and name for name in names):
        raise LearningError(
            f"{path}: found sensor {names[0]!r}, indenter {names[1]!r}; allowed: names"
        )
    return ForceDepthCurve(
        str(names[0]),
        str(names[1]),
        f"session {path.name}",
        _finite_points(curves.depth, curves.loading),
        _finite_points(curves.depth, curves.unloading),
    )


def _indenter(sensor: str, table: Table, rows: NDArray[np.bool_], indenters: Sequence[str]) -> str:
    names = [str(indenters[code]) for code in np.unique(table["indenter"][rows])]
    if INDENTER in names:
        return INDENTER
    if len(names) > 1:
        raise LearningError(
            f"{sensor}: found force-depth presses of {', '.join(names)}; allowed: one indenter, or "
            f"{INDENTER} among them"
        )
    return names[0]


def _finite_points(depth: Floats, force: Floats) -> Floats:
    """Return depth and force (n, 2) of curves (r, m) over common depths (m,), without gaps."""
    pairs = np.stack([np.broadcast_to(depth, force.shape), force], axis=-1).reshape(-1, 2)
    return pairs[np.isfinite(pairs[:, 1]) & (pairs[:, 0] > 0)]


# Degree of the fitted polynomials (the paper, Results, material softness).
DEGREE = 2
# Phases that use the loading curve; the two others use the unloading one (authors' code).
LOADING = (PHASES.index("normal_inc"), PHASES.index("shear_inc"))


@dataclass(frozen=True, slots=True)
class Branch:
    """Compression over depth in one direction."""

    coefficients: tuple[float, ...]
    """Polynomial in the fraction of the depth range, highest power first [N]."""
    residual: float | None = None
    """Root mean square of the fit's residuals [N]; None if nothing was fitted."""
    samples: int = 0
    """Number of fitted forces."""

    def compression(self, fraction: Floats) -> Floats:
        """Return the compression (n,) [N] at fractions of the depth range (n,)."""
        return np.asarray(np.polyval(self.coefficients, fraction), np.float64)


@dataclass(frozen=True, slots=True)
class Prior:
    """Stiffness of one sensor, measured with a flat indenter."""

    sensor: str
    loading: Branch
    unloading: Branch
    depth_range: float
    """Depth that counts as 1 [m].

    Two sensors are compared at the same fraction of their ranges, which is the same depth if the
    ranges are equal (the paper, Methods: heterogeneous).
    """
    depth_max: float
    """Greatest measured depth [m]; there is no extrapolation beyond it."""
    indenter: str = ""
    source: str = ""
    """Description of the measurement."""

    def __post_init__(self) -> None:
        for name in ("depth_range", "depth_max"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise LearningError(
                    f"prior {self.sensor}.{name}: found {value} m; allowed: above 0"
                )
        for name in ("loading", "unloading"):
            coefficients = getattr(self, name).coefficients
            if not coefficients or not np.isfinite(coefficients).all():
                raise LearningError(
                    f"prior {self.sensor}.{name}: found {coefficients}; allowed: finite "
                    "coefficients"
                )

    @property
    def share_max(self) -> float:
        """Greatest measured fraction of the range."""
        return self.depth_max / self.depth_range

    def branch(self, loading: bool) -> Branch:
        """Return the curve of one direction."""
        return self.loading if loading else self.unloading


def fit_prior(measured: ForceDepthCurve, depth_range: float | None = None) -> Prior:
    """Fit polynomials of degree 2; depth 1 is `depth_range` [m], by default the greatest one."""
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
    sensor: str, coefficients: Compensation, *, depth_range: float, per_mm: bool, source: str
) -> Prior:
    """Return a prior with published coefficients, whose depth 1 is `depth_range` [m].

    They are of depth in mm (`per_mm`, the material test) or of its fraction of the range
    (heterogeneous test). A negative force at the end of the range is taken as a gauge with negative
    compression: signs are flipped. `source` describes their origin.
    """
    unit = depth_range * 1e3 if per_mm else 1.0
    loading, unloading = _converted(coefficients.down, unit), _converted(coefficients.up, unit)
    return Prior(sensor, loading, unloading, depth_range, depth_range, source=source)


def _converted(values: tuple[float, ...], unit: float) -> Branch:
    """Convert a polynomial of depth, where `unit` is the whole range, to one of the fraction."""
    powers = np.arange(len(values) - 1, -1, -1)
    coefficients = np.asarray(values, np.float64) * unit**powers
    sign = -1.0 if coefficients.sum() < 0 else 1.0
    return Branch(tuple(float(value) for value in sign * coefficients))


def _fitted(sensor: str, name: str, pairs: Floats, span: float) -> Branch:
    prefix = f"prior {sensor}.{name}"
    if not np.isfinite(pairs).all():
        raise LearningError(f"{prefix}: found NaN or infinity; allowed: numbers")
    depths = len(np.unique(pairs[:, 0].round(9))) if len(pairs) else 0
    if depths <= DEGREE:
        raise LearningError(
            f"{prefix}: found forces at {depths} depths; allowed: {DEGREE + 1} or more"
        )
    fraction, force = pairs[:, 0] / span, pairs[:, 1]
    powers = np.vander(fraction, DEGREE + 1)
    coefficients = np.linalg.lstsq(powers, force, rcond=None)[0]
    residual = float(np.sqrt(np.mean((powers @ coefficients - force) ** 2)))
    deepest = force[fraction >= np.quantile(fraction, 0.9)].mean()
    if not deepest > 0:
        raise LearningError(
            f"{prefix}: found {deepest:.3g} N of compression at its deepest; allowed: above 0 "
            "(compression is negative Fz)"
        )
    return Branch(tuple(float(value) for value in coefficients), residual, len(pairs))


# Equations 7 to 9: forces scaled by the ratio of two skins at the same depth (supplement, Text 9).
#
#     r = f_T / f_S - 1        F_SC = F_S (1 + lambda r) where d > d0, else F_S
#
# The ratio f_T / f_S is of the loading curves in loading phases, else of the unloading curves.

# Limits of f_T / f_S: the ratio is meaningless where the source's force is close to zero.
LEAST, LARGEST = 0.1, 10.0
# Default without any label of the target: the most frequent d0 and the median lambda of the
# supplement's 48 choices (Tables S1 and S2).
DEFAULT_D0, DEFAULT_WEIGHT = 0.0, 0.75


def compensate(
    wrench: NDArray[np.floating],
    depth: Floats,
    phase: NDArray[np.integer],
    source: Prior,
    target: Prior,
    d0: float,
    lam: float,
) -> tuple[Floats, int]:
    """Return the source's labels compensated for the target, and the number that were clamped.

    Labels are (n, 3) or (n, 6) [N, N m]; NaN is no label and remains. All axes, torques included,
    are scaled by the same factor (authors' code). Depths (n,) [m] are the source's; codes of phases
    (n,) are -1 only where nothing is compensated. `d0` is the fraction of the source's depth range
    below which labels are unchanged, `lam` the weight of the correction, both 0 to 1.
    """
    forces: Floats = np.asarray(wrench, np.float64)
    depth = np.asarray(depth, np.float64)
    require_choice(d0, lam)
    ratio, clamped = ratios(depth, phase, source, target)
    deep = depth / source.depth_range > d0
    unknown = np.flatnonzero(deep & ((phase < 0) | (phase >= len(PHASES))))
    if unknown.size:
        raise LearningError(
            f"phase: found {phase[unknown[0]]} in row {unknown[0]}, which is pressed; allowed: "
            f"0 to {len(PHASES) - 1}"
        )
    scale = np.where(deep, 1.0 + lam * (ratio - 1.0), 1.0)
    return forces * scale[:, None], int(np.count_nonzero(clamped & deep)) if lam > 0 else 0


def ratios(
    depth: Floats, phase: NDArray[np.integer], source: Prior, target: Prior
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return f_T / f_S (n,), clamped to `LEAST` and `LARGEST`, and a mask of the clamped ones.

    Both curves are evaluated at the same fraction of their ranges. Beyond the greatest depth
    measured for both, the ratio is constant. Where the source's curve is at or below 0 the ratio is
    the largest, or 1 if the target's curve is too.
    """
    fraction = np.clip(depth / source.depth_range, 0.0, min(source.share_max, target.share_max))
    loading = np.isin(phase, LOADING)
    own, other = (
        np.where(
            loading, prior.loading.compression(fraction), prior.unloading.compression(fraction)
        )
        for prior in (source, target)
    )
    pushes = own > 0
    ratio = np.where(pushes, other / np.where(pushes, own, 1.0), np.where(other > 0, np.inf, 1.0))
    clamped = np.clip(ratio, LEAST, LARGEST)
    return clamped, (clamped != ratio) | ~pushes


def require_choice(d0: float, lam: float) -> None:
    """Reject a starting depth or a weight outside of the paper's ranges."""
    for name, value in (("d0", d0), ("lambda", lam)):
        if not 0.0 <= value <= 1.0:
            raise LearningError(f"{name}: found {value}; allowed: 0 to 1")
