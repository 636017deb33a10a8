"""Displacement of a sensor's top, from which every signal is computed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import map_coordinates

from sim.arrays import Array
from sim.errors import SceneError
from sim.result import Result
from sim.scene import Body

Places = NDArray[np.float32]

# Spacing of the even grid on which slopes are computed [m]: a few times finer than any mesh.
EVEN_STEP = 0.2e-3


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceField:
    """Displacement of the material points of a top in F frames; contact frame, SI units.

    Raises:
        SceneError: An axis does not ascend, shapes do not match, or a number is not finite.
    """

    x: Array
    """x of the undeformed points (X,) [m]."""
    y: Array
    """y of the undeformed points (Y,) [m]."""
    displacement: Places
    """Displacement (F, X, Y, 3) [m]."""

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            axis = getattr(self, name)
            if axis.ndim != 1 or len(axis) < 2 or not (np.diff(axis) > 0).all():
                raise SceneError(
                    f"field.{name}: shape {axis.shape}; allowed: 2 or more ascending numbers"
                )
        allowed = (len(self.x), len(self.y), 3)
        shape = self.displacement.shape
        if self.displacement.ndim != 4 or shape[1:] != allowed:
            raise SceneError(
                f"field.displacement: shape {shape!r}; allowed: (frames, x, y, 3) with "
                f"{len(self.x)} x and {len(self.y)} y"
            )
        if not np.isfinite(self.displacement).all():
            bad = int((~np.isfinite(self.displacement)).any(axis=(1, 2, 3)).argmax())
            raise SceneError(f"field.displacement: frame {bad} holds NaN or inf; allowed: finite")

    @classmethod
    def of(cls, result: Result) -> SurfaceField:
        """Return the surface of a simulated scene."""
        return cls(result.surface_x, result.surface_y, result.surface)

    @classmethod
    def undeformed(cls, body: Body) -> SurfaceField:
        """Return one frame of an undeformed top."""
        x, y = (np.linspace(-size / 2, size / 2, 4) for size in (body.size_x, body.size_y))
        return cls(x, y, np.zeros((1, 4, 4, 3), np.float32))

    def __len__(self) -> int:
        return len(self.displacement)

    def at(self, places: Array) -> Array:
        """Return displacement (F, n, 3) at points (n, 2) [m]; beyond the grid, that of its edge."""
        across_x = cubic_weights(self.x, places[:, 0])
        across_y = cubic_weights(self.y, places[:, 1])
        frames, rows, columns, _ = self.displacement.shape
        # (n, X) @ (F, X, Y * 3): a line along y for every point, then one value of each line.
        flat = self.displacement.reshape(frames, rows, columns * 3).astype(float)
        lines = (across_x @ flat).reshape(frames, len(places), columns, 3)
        return np.asarray(np.einsum("fnyc,ny->fnc", lines, across_y))

    def resampled(self, x: Array, y: Array) -> SurfaceField:
        """Return the field on another grid: cubic interpolation, edge values beyond the old one."""
        across_x, across_y = cubic_weights(self.x, x), cubic_weights(self.y, y)
        planes = np.moveaxis(self.displacement, 3, 1).astype(float)
        moved = np.moveaxis(across_x @ planes @ across_y.T, 1, 3)
        return SurfaceField(x, y, moved.astype(np.float32))

    def even(self) -> SurfaceField:
        """Return the field on an even grid of about `EVEN_STEP` over the same rectangle."""
        axes = []
        for axis in (self.x, self.y):
            count = max(2, round((axis[-1] - axis[0]) / EVEN_STEP) + 1)
            axes.append(np.linspace(axis[0], axis[-1], count))
        return self.resampled(*axes)

    def crept(self, offset: Array) -> SurfaceField:
        """Return the field of a skin that crept by `offset` (2,) [m] before the indenter pressed.

        The indenter does not move with it: u(X) becomes offset + u(X + offset).
        """
        if not offset.any():
            return self
        shift = np.array([*offset, 0.0], np.float32)
        return SurfaceField(self.x - offset[0], self.y - offset[1], self.displacement + shift)

    def turned(self, angle: float) -> SurfaceField:
        """Return the field in a frame rotated by `angle` about z [rad], on an even grid.

        The point X there is R X here, with R the rotation: u'(X) = R^T u(R X). The rectangle itself
        is assumed to lie along the axes of both frames.
        """
        if angle == 0:
            return self
        even = self.even()
        cosine, sine = np.cos(angle), np.sin(angle)
        x, y = np.meshgrid(even.x, even.y, indexing="ij")
        steps = even.x[1] - even.x[0], even.y[1] - even.y[0]
        indices = np.stack(
            [
                (cosine * x - sine * y - even.x[0]) / steps[0],
                (sine * x + cosine * y - even.y[0]) / steps[1],
            ]
        )
        moved = np.empty_like(even.displacement)
        for frame, output in zip(even.displacement, moved, strict=True):
            for component in range(3):
                map_coordinates(
                    frame[..., component],
                    indices,
                    output=output[..., component],
                    order=3,
                    mode="nearest",
                )
        back = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float32)
        return replace(even, displacement=moved @ back)


def cubic_weights(knots: Array, places: Array) -> Array:
    """Return weights (W, K) that interpolate values at `knots` (K,) to `places` (W,).

    The interpolant is a cubic Hermite curve with three-point slopes: exact for parabolas, C1, and
    each value affects at most two intervals on either side. Beyond the ends it is constant.
    """
    unit = np.eye(len(knots))
    slopes = np.gradient(unit, knots, axis=0, edge_order=2 if len(knots) > 2 else 1)
    curve = CubicHermiteSpline(knots, unit, slopes, axis=0)
    return np.asarray(curve(np.clip(places, knots[0], knots[-1])))


def outward_normals(field: SurfaceField) -> Array:
    """Return unit normals (F, X, Y, 3) of the displaced top, out of the material.

    They are cross products of the displaced grid's tangents, exact at any rotation and stretch.
    """
    u = field.displacement.astype(float)
    tangent_x = np.gradient(u, field.x, axis=1, edge_order=1) + np.array([1.0, 0.0, 0.0])
    tangent_y = np.gradient(u, field.y, axis=2, edge_order=1) + np.array([0.0, 1.0, 0.0])
    normal = np.cross(tangent_x, tangent_y)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    # A surface folded flat has no normal; it keeps that of the undeformed surface.
    return np.where(length > 0, normal / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
