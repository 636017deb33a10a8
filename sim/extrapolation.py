"""Forces in the limit of zero element size, from two meshes: Richardson extrapolation.

The discretisation error of a press falls about as the square of the elements' size. Two meshes give
its size, and the force without it. So two coarse meshes are more accurate than a finer one that
takes longer: docs/results/speed.md, on the paper's presses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recorder.progress import part_of
from sim.error_estimate import fineness_of, measured, unknown_at_side
from sim.errors import SceneError, SimulationDiverged
from sim.fem.numerics import FOR_EDGES, Fem, Grading
from sim.metrics import force_scale
from sim.result import Outcome, Result
from sim.scene import Scene
from sim.symmetry import with_symmetry
from sim.tiers import Solvers, running, simulate_many

Array = NDArray[np.float64]

# Power of the elements' size with which the error falls: linear elements, smooth pressure.
ORDER = 2.0
# Fineness of the coarser mesh from which errors fall as the square of the elements' size. At half
# of it, the error may be twice as large, and so on up to that of order 1.
SQUARE_FROM = 0.375
# Largest ratio of the element sizes of both meshes: random errors of both forces are multiplied by
# 1 / (COARSER^2 - 1).
COARSER = 5 / 3
# Least number of elements over the depth of the coarser mesh.
COARSEST_CELLS = 3
# Largest side of the finest elements over their height: under wider ones the contact jumps from
# node to node, and the error does not fall evenly.
FINER = 0.5


def simulate_extrapolated(
    scenes: Sequence[Scene],
    fine: Fem = Fem(grading=FOR_EDGES),
    *,
    device: str = "cpu",
    processes: int | Solvers = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Outcome]:
    """Simulate by `fem` on the mesh of `fine` and a coarser one; see `extrapolated`.

    Arguments as in `simulate_many`. A scene fails if it fails on either mesh.

    Raises:
        SceneError: As in `simulate_many`; the mesh has no coarser one, or its elements under the
            indenter are not narrower than high; the bodies have several thicknesses.
        WorkerLost: As in `simulate_many`.
    """
    if not scenes:
        return []
    grading = fine.grading or Grading()
    if grading.finer > FINER:
        raise SceneError(
            f"fem.grading.finer: {grading.finer:g}; allowed where forces are "
            f"extrapolated: {FINER:g} or less, such as sim.fem.numerics.FOR_EDGES"
        )
    coarse = replace(fine, spacing=_coarser(scenes, fine))
    if processes != 1:
        with running(processes, device, 2 * len(scenes)) as solvers:
            found = solvers.simulate(scenes, (fine, coarse), progress)[::-1]
    else:
        found = [
            simulate_many(
                scenes,
                each,
                device=device,
                processes=processes,
                progress=None if progress is None else part_of(progress, number, 2),
            )
            for number, each in enumerate((coarse, fine))
        ]
    return [_of_both(*both) for both in zip(*found, strict=True)]


def extrapolated(coarse: Result, fine: Result) -> Result:
    """Return `fine` with the extrapolated wrench; `record["extrapolated"]` has the details.

    F = F_fine + (F_fine - F_coarse) / (r^2 - 1), r the ratio of the elements' sizes (Richardson
    1911). Displacement and traction stay those of the finer mesh. Keys: `order`; `cells`, elements
    over the depth of both meshes; `force_share`, the correction of the force over the force,
    largest over the frames.

    Raises:
        SceneError: The first mesh is not the coarser one.
    """
    cells = [int(one.record["mesh"]["cells"][2]) for one in (coarse, fine)]
    if cells[0] >= cells[1]:
        raise SceneError(
            f"extrapolated: {cells[0]} and {cells[1]} elements over the depth; allowed: fewer, "
            "then more"
        )
    ratio = cells[1] / cells[0]
    more = (fine.wrench - coarse.wrench) * left_of_difference(ratio)
    largest = float(np.linalg.norm(fine.force, axis=1).max())
    fraction = float(np.linalg.norm(more[:, :3], axis=1).max()) / largest if largest > 0 else 0.0
    found = with_symmetry(replace(fine, wrench=fine.wrench + more))
    apart = np.abs(fine.force - coarse.force).max(axis=1) / force_scale(found.force)
    error = unknown_at_side(fine, measured=True) or measured(
        found, apart * most_of_difference(coarse, ratio), "two meshes, extrapolated"
    )
    how = {"order": ORDER, "cells": cells, "force_share": fraction}
    return replace(found, record={**found.record, "extrapolated": how, "error": error})


def left_of_difference(ratio: float) -> float:
    """Return the finer mesh's error over the difference of two meshes with this size `ratio`."""
    return 1.0 / (float(ratio**ORDER) - 1.0)


def most_of_difference(coarse: Result, ratio: float) -> Array:
    """Return the largest error of the finer mesh over the difference of both, per frame (F,).

    It is `left_of_difference`, or more if the `coarse` mesh barely resolves the contact.
    """
    more = np.clip(SQUARE_FROM / fineness_of(coarse), 1.0, ratio + 1.0)
    return np.asarray(left_of_difference(ratio) * more)


def _of_both(coarse: Outcome, fine: Outcome) -> Outcome:
    if isinstance(fine, SimulationDiverged):
        return fine
    return coarse if isinstance(coarse, SimulationDiverged) else extrapolated(coarse, fine)


def _coarser(scenes: Sequence[Scene], numerics: Fem) -> float:
    """Return the size of an element of the coarser mesh [m]."""
    thicknesses = {scene.body.thickness for scene in scenes}
    if len(thicknesses) > 1:
        raise SceneError(
            f"scenes: bodies of {len(thicknesses)} thicknesses; allowed where forces are "
            "extrapolated: one"
        )
    (thickness,) = thicknesses
    fine = numerics.height(scenes[0].body)
    cells = round(thickness / fine)
    if cells <= COARSEST_CELLS:
        raise SceneError(
            f"fem.spacing: {fine * 1e3:.3g} mm; allowed where forces are extrapolated: "
            f"{thickness / (COARSEST_CELLS + 1) * 1e3:.3g} mm or less in {thickness * 1e3:g} mm"
        )
    return thickness / max(COARSEST_CELLS, math.ceil(cells / COARSER))
