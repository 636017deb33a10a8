# mypy: ignore-errors
# Drives and reads Warp arrays, typed at run time; mypy cannot follow them.
"""Batches of presses that are solved at once, and the precision of each."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from recorder.progress import span_of
from sim.errors import SimulationDiverged
from sim.fem.assembly import is_split
from sim.fem.mesh import Mesh, meshes_of
from sim.fem.numerics import Fem
from sim.fem.sizing import Sizes
from sim.fem.stepping import Batch
from sim.indenters.device import traits_of
from sim.result import Outcome
from sim.scene import Scene

Progress = Callable[[float], None]

# Times that `auto` halves a step to a waypoint in float32 before it goes on in float64. Most such
# steps are limited by rounding, where forces or elements are small, and each costs as much as ten
# steps that converge.
HALVINGS_FLOAT32 = 1
# Most elements per batch: those that fit a CPU's cache or a GPU's memory.
ELEMENTS_SIDE_BY_SIDE = {"cpu": 20_000, "cuda": 20_000_000}
# Elements per thickness up to which `Fem.penalty` applies unchanged. With smaller elements
# contact is stiffer by the same factor, in powers of 2, because small contacts reach the same
# pressure over smaller depths.
SOFT_SHARE = 24
# Instantaneous over relaxed stiffness of a viscous body above which contact is made stiffer: with a
# ratio of 100 the indenter stood 10 % of its depth inside the skin.
STIFF_AT_ONCE = 4.0


def solve_on_meshes(
    scenes: Sequence[Scene],
    numerics: Fem,
    sizes: Sequence[Sizes] | None,
    device: str,
    progress: Progress | None,
) -> list[Outcome]:
    """Solve presses on meshes of the given element sizes, or on those of the numerics."""
    began = time.perf_counter()
    meshes = meshes_of(scenes, numerics, sizes)
    meshed = (time.perf_counter() - began) / max(len(scenes), 1)
    outcomes: dict[int, Outcome] = {}
    for chosen in _batches(scenes, meshes, numerics, device):
        fraction = None
        if progress is not None:
            fraction = span_of(progress, len(outcomes), len(chosen), len(scenes))
        stiffer = replace(
            numerics, penalty=_penalty(scenes[chosen[0]], meshes[chosen[0]], numerics)
        )
        some = _solve(
            [scenes[i] for i in chosen],
            [meshes[i] for i in chosen],
            stiffer,
            device,
            meshed * len(chosen),
            fraction,
        )
        outcomes.update(zip(chosen, some, strict=True))
    return [outcomes[i] for i in range(len(scenes))]


def _penalty(scene: Scene, mesh: Mesh, numerics: Fem) -> float:
    """Return the contact stiffness on a mesh [E / T]."""
    finer = max(1.0, 1.0 / (SOFT_SHARE * mesh.finest)) if numerics.follows else 1.0
    viscosity = scene.effects.viscosity
    at_once = 1.0 if viscosity is None else 1.0 + sum(viscosity.ratios)
    stiffer = max(1.0, at_once / STIFF_AT_ONCE)
    return float(numerics.penalty * 2.0 ** (np.round(np.log2(finer)) + np.round(np.log2(stiffer))))


def _batches(
    scenes: Sequence[Scene], meshes: Sequence[Mesh], numerics: Fem, device: str
) -> list[list[int]]:
    """Group scenes into batches of the same mesh topology and kernels, limited in size."""
    alike: dict[tuple, list[int]] = {}
    for index, (scene, mesh) in enumerate(zip(scenes, meshes, strict=True)):
        kernels = scene.effects.key, traits_of([scene.indenter]), is_split([scene])
        key = scene.body.thickness, mesh.cells, kernels, _penalty(scene, mesh, numerics)
        alike.setdefault(key, []).append(index)
    most = ELEMENTS_SIDE_BY_SIDE["cuda" if wp.get_device(device).is_cuda else "cpu"]
    batches = []
    for group in alike.values():
        size = max(1, most // len(meshes[group[0]].elements))
        batches += [group[i : i + size] for i in range(0, len(group), size)]
    return batches


def _solve(scenes, meshes, numerics, device, meshed, progress) -> list[Outcome]:
    """Solve one batch, in the requested precision or the one that it needs."""
    if numerics.precision != "auto":
        batch = Batch(scenes, meshes, numerics, numerics.precision, device, meshed, progress)
        return batch.run()
    trial = replace(numerics, halvings=min(numerics.halvings, HALVINGS_FLOAT32))
    batch = Batch(scenes, meshes, trial, "float32", device, meshed, progress)
    outcomes = batch.run()
    again = [i for i in range(len(outcomes)) if batch.may_go_on(i)]
    if again:
        reached = batch.reached(again)
        del batch  # frees its memory on the device
        retried = Batch(
            [scenes[i] for i in again],
            [meshes[i] for i in again],
            numerics,
            "float64",
            device,
            meshed,
            progress,
            reached,
        ).run()
        for i, outcome in zip(again, retried, strict=True):
            outcomes[i].forget_dump()
            outcomes[i] = _with_reason(outcome, f"float32 did not converge: {outcomes[i]}")
    return outcomes


def _with_reason(outcome: Outcome, reason: str) -> Outcome:
    if isinstance(outcome, SimulationDiverged):
        return outcome
    return replace(outcome, record={**outcome.record, "precision_reason": reason})
