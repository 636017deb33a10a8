"""All 18 indenters pressed and sheared, on a series of meshes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.indenters import NAMES, Indenter, named
from sim.result import Result
from sim.scene import Effects, Friction, Scene, press
from sim.tiers import simulate_many

DEPTH, SHEAR, FRICTION = 1.5e-3, 1.0e-3, 0.5
# Edge radius given to every shape that has room for it [m]: an element size of the finer meshes,
# because with an edge sharper than an element the force depends on the path.
EDGE = 0.5e-3
# Number of frames of each phase.
STEPS = 2


@dataclass(frozen=True, slots=True)
class ShapeRow:
    """Forces of one shape on one mesh: pressed, then sheared, or why they are missing."""

    name: str
    edge_radius: float
    """Edge radius used [m]; 0 for shapes without an edge."""
    spacing: float
    """Element size [m]."""
    pressed: float
    """Normal force at full depth [N], pressing positive."""
    sheared: float
    """Shear force at full shear [N]."""
    det_f_min: float
    balance: float
    diverged: str
    """Message of the solver; empty if it converged."""


def rounded(name: str) -> Indenter:
    """Return the named shape with the edge radius used here."""
    own = named(name)
    if own.edge_radius == 0:
        return own
    return named(name, min(EDGE, own.edge_radius_max))


def shape_rows(
    spacings: Sequence[float], device: str, *, names: Sequence[str] = NAMES
) -> Iterator[tuple[float, float, list[ShapeRow]]]:
    """Yield for each spacing [m] the spacing, wall seconds and rows of all shapes in one batch."""
    scenes = [
        Scene(
            rounded(name),
            press([DEPTH], shear=SHEAR, steps=STEPS),
            effects=Effects(friction=Friction(FRICTION)),
        )
        for name in names
    ]
    for spacing in spacings:
        began = time.perf_counter()
        outcomes = simulate_many(scenes, Fem(spacing=spacing), device=device)
        seconds = time.perf_counter() - began
        rows = [
            _row(scene.indenter, spacing, outcome)
            for scene, outcome in zip(scenes, outcomes, strict=True)
        ]
        yield spacing, seconds, rows


def _row(indenter: Indenter, spacing: float, outcome: Result | SimulationDiverged) -> ShapeRow:
    nothing = float("nan")
    if isinstance(outcome, SimulationDiverged):
        return ShapeRow(
            indenter.name,
            indenter.edge_radius,
            spacing,
            nothing,
            nothing,
            nothing,
            nothing,
            str(outcome),
        )
    return ShapeRow(
        name=indenter.name,
        edge_radius=indenter.edge_radius,
        spacing=spacing,
        pressed=float(-outcome.force[STEPS, 2]),
        sheared=float(outcome.force[2 * STEPS, 0]),
        det_f_min=float(outcome.quality.det_f_min.min()),
        balance=float(outcome.quality.balance.max()),
        diverged="",
    )
