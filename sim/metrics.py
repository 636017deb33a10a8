"""Errors of an outcome relative to a reference, and the tolerance of a user: force, markers."""

import math
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, RectBivariateSpline

from sim.arrays import Array
from sim.errors import SceneError
from sim.result import Result, force_scale
from sim.scene import Body

# The parts of a result that are compared.


@dataclass(frozen=True, slots=True)
class Outcome:
    """Force, surface and touched points of F frames; SI units, contact frame."""

    force: Array
    """Force of the indenter on the body (F, 3) [N]."""
    surface_x: Array
    """x of the material points of the top (X,) [m], rising, evenly spaced or not."""
    surface_y: Array
    """y of the material points of the top (Y,) [m]."""
    surface: NDArray[np.float32]
    """Displacement of those points (F, X, Y, 3) [m]."""
    touched: NDArray[np.bool_]
    """True for points with traction (F, X, Y)."""


def outcome_of(result: Result) -> Outcome:
    """Return the compared parts of `result`; points without traction (NaN) count as not touched."""
    return Outcome(
        force=np.asarray(result.force, np.float64),
        surface_x=result.surface_x,
        surface_y=result.surface_y,
        surface=result.surface,
        touched=np.asarray((np.abs(result.traction) > 0).any(axis=-1)),
    )


# Images of markers on the top of the gel, in a camera below it: the paper's pinhole.

# Markers along each side of the body.
MARKERS = 14


def marker_places(body: Body) -> tuple[Array, Array]:
    """Return x (14,) and y (14,) of the regular grid of markers on the undeformed top [m]."""
    fraction = (np.arange(MARKERS) + 0.5) / MARKERS - 0.5
    return fraction * body.size_x, fraction * body.size_y


def force_errors(outcome: Outcome, reference: Outcome) -> tuple[Array, Array]:
    """Return `Errors.force` (F, 3) [N] and `Errors.force_share` (F, 3)."""
    force = np.abs(outcome.force - reference.force)
    return force, force / force_scale(reference.force)[:, None]


def marker_errors(outcome: Outcome, reference: Outcome, body: Body) -> Array:
    """Return distances between the two images of every marker on the body (F, up to 196) [px]."""
    moved = marker_pixels(outcome, body) - marker_pixels(reference, body)
    x, y = marker_places(body)
    return np.asarray(np.linalg.norm(moved, axis=-1)[:, body.covers(x[:, None], y)])


def marker_pixels(outcome: Outcome, body: Body) -> Array:
    """Return pixels (F, 14, 14, 2) of the markers in each frame, y up from the image's middle."""
    # Drawing markers imports image libraries, which a machine that only measures may not have.
    from sim.markers.camera import Camera

    x, y = marker_places(body)
    rest = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    height = body.heights(x, y)
    undeformed = np.concatenate([rest, height[..., None]], axis=-1)
    inner_x = np.clip(x, outcome.surface_x[0], outcome.surface_x[-1])
    inner_y = np.clip(y, outcome.surface_y[0], outcome.surface_y[-1])
    moved = [
        displacement_at(outcome, frame, inner_x, inner_y) for frame in range(len(outcome.force))
    ]
    return Camera.paper().on_film(undeformed + np.stack(moved))


def displacement_at(outcome: Outcome, frame: int, x: Array, y: Array) -> Array:
    """Return displacements (X, Y, 3) of the material points at x (X,), y (Y,) [m]."""
    # Splines over the points' numbers: over their positions they overshoot, by many times all
    # displacements, in a wide element beside narrow ones.
    axes = [np.arange(len(nodes)) for nodes in (outcome.surface_x, outcome.surface_y)]
    at_x, at_y = (
        PchipInterpolator(nodes, numbers)(places)
        for nodes, numbers, places in zip(
            (outcome.surface_x, outcome.surface_y), axes, (x, y), strict=True
        )
    )
    degree_x, degree_y = (min(3, len(axis) - 1) for axis in axes)
    components = []
    for component in range(3):
        values = outcome.surface[frame, :, :, component].astype(np.float64)
        spline = RectBivariateSpline(*axes, values, kx=degree_x, ky=degree_y)
        components.append(spline(at_x, at_y))
    return np.stack(components, axis=-1)


# Error that a user accepts: "2 %", "0.05 N" or "0.5 px".

Kind = Literal["fraction", "force", "marker"]
ALLOWED = 'a number above 0 with its unit: "2 %", "0.05 N" or "0.5 px"'
_UNITS: dict[str, tuple[Kind, float]] = {
    "%": ("fraction", 0.01),
    "N": ("force", 1.0),
    "mN": ("force", 1e-3),
    "px": ("marker", 1.0),
}


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Largest accepted error at any frame.

    `fraction`: |F_i - Ftrue_i| along x, y or z over max(|Ftrue| of the frame, a tenth of the
    largest); `force`: |F_i - Ftrue_i| [N]; `marker`: root mean square of the distances between 14 x
    14 markers' images and their true positions [px], in the paper's camera.
    """

    kind: Kind
    value: float

    def __str__(self) -> str:
        """Return the tolerance with its unit, in the form that `tolerance_of` reads."""
        return with_unit(self.kind, self.value)


def tolerance_of(text: str) -> Tolerance:
    """Parse a tolerance."""
    match = re.fullmatch(r"\s*(\S+?)\s*(%|mN|N|px)\s*", text) if isinstance(text, str) else None
    try:
        number = float(match[1]) if match else math.nan
    except ValueError:
        number = math.nan
    if match is None or not (math.isfinite(number) and number > 0):
        raise SceneError(f"tolerance: {text!r}; allowed: {ALLOWED}")
    kind, unit = _UNITS[match[2]]
    return Tolerance(kind, number * unit)


def with_unit(kind: Kind, value: float) -> str:
    """Return a value of a kind with its unit."""
    if kind == "fraction":
        return f"{100 * value:.3g} %"
    return f"{value:.3g} {'N' if kind == 'force' else 'px'}"
