"""The bench problem on a series of meshes, compared with results of two element families."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.independent.formulas import NEO_HOOKEAN_SPHERE
from sim.fem import Fem
from sim.indenters import sphere
from sim.result import Result
from sim.scene import Body, Scene, press
from sim.tiers import simulate

# Radius outside of the deepest contact, where surfaces are compared [m]: at the contact edge the
# accuracy is limited to the size of an element.
FAR = 4e-3


@dataclass(frozen=True, slots=True)
class BenchRow:
    """Results on one mesh."""

    spacing: float
    """Element size [m]."""
    cells: tuple[int, int, int]
    force: tuple[float, ...]
    """Forces at the reference's depths [N]."""
    error: tuple[float, ...]
    """Errors of the force, relative to the reference."""
    field_error: float
    """Largest difference from the reference's surface values [m]."""
    finest_error: float
    """Largest difference of the surface from that on the finest mesh, outside `FAR` [m]."""
    newton: int
    cg: int
    seconds: float
    """Wall time of the press, with kernels compiled before."""
    result: Result


def bench_rows(spacings: Sequence[float], device: str) -> Iterator[BenchRow]:
    """Yield the results at each spacing [m], the finest first, as the reference of the surface."""
    reference = NEO_HOOKEAN_SPHERE
    scene = Scene(sphere(reference.radius), press(reference.depths), body=Body())
    finest: Result | None = None
    simulate(scene, Fem(spacing=max(spacings)), device=device)
    for spacing in sorted(spacings):
        began = time.perf_counter()
        result = simulate(scene, Fem(spacing=spacing), device=device)
        seconds = time.perf_counter() - began
        finest = finest or result
        force = -result.force[1:, 2]
        quality = result.quality
        yield BenchRow(
            spacing=spacing,
            cells=tuple(result.record["mesh"]["cells"]),
            force=tuple(float(value) for value in force),
            error=tuple(float(value) for value in force / np.array(reference.forces) - 1),
            field_error=_field_error(result),
            finest_error=_difference(result, finest),
            newton=int(quality.newton.sum()),
            cg=int(quality.cg.sum()),
            seconds=seconds,
            result=result,
        )


def convergence_rate(rows: Sequence[BenchRow]) -> float:
    """Fit the exponent p of error ~ spacing^p to the mean force error over the depths.

    Errors are relative to the finest mesh, which is excluded from the fit: its own error is due to
        the penalty.
    """
    finest, *others = sorted(rows, key=lambda row: row.spacing)
    target = np.array(finest.force)
    spacing = np.log([row.spacing for row in others])
    error = np.log([np.abs(np.array(row.force) / target - 1).mean() for row in others])
    return float(np.polyfit(spacing, error, 1)[0])


def _field_error(result: Result) -> float:
    """Return the largest difference from the reference's heights and outward shifts along x [m]."""
    reference = NEO_HOOKEAN_SPHERE
    middle = len(result.surface_y) // 2
    exact = len(result.surface_y) % 2 == 1
    line = result.surface[-1][:, middle]
    if not exact:
        line = (line + result.surface[-1][:, middle - 1]) / 2
    height = _at(result.surface_x, line[:, 2], reference.height_at)
    outward = _at(result.surface_x, line[:, 0], reference.outward_at)
    return float(
        max(
            np.abs(height - np.array(reference.height)).max(),
            np.abs(outward - np.array(reference.outward)).max(),
        )
    )


def _at(
    x: NDArray[np.float64], values: NDArray[np.float32], places: Sequence[float]
) -> NDArray[np.float64]:
    """Return the values at `places` [m] by a cubic through the four nearest nodes."""
    found = []
    for place in places:
        first = int(np.clip(np.searchsorted(x, place) - 2, 0, len(x) - 4))
        near = slice(first, first + 4)
        found.append(np.polyval(np.polyfit(x[near] - place, values[near].astype(float), 3), 0.0))
    return np.array(found)


def _difference(result: Result, finest: Result) -> float:
    """Return the largest distance of two surfaces at nodes of the first outside `FAR` [m]."""
    from scipy.interpolate import RegularGridInterpolator

    field = RegularGridInterpolator(
        (finest.surface_x, finest.surface_y), finest.surface[-1].astype(float), method="cubic"
    )
    x, y = np.meshgrid(result.surface_x, result.surface_y, indexing="ij")
    inside = np.maximum(np.abs(x), np.abs(y)) < finest.surface_x[-1]
    outside = np.hypot(x, y) > FAR
    chosen = inside & outside
    difference = result.surface[-1][chosen] - field(np.stack([x[chosen], y[chosen]], axis=-1))
    return float(np.linalg.norm(difference, axis=1).max())
