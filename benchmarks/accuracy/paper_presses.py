"""The paper's 162 presses, their forces by a fine mesh, and errors relative to those."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.store import replace_file
from sim.indenters import NAMES, named
from sim.paper_presses import DEPTHS_MM, FRICTION, PLACES_MM
from sim.result import Outcome, Result
from sim.scene import Effects, Friction, Scene, press
from sim.tolerance import left_of_difference

# Middle, corner and side [mm], which by symmetry represent all nine places.
REFERENCE_AT = ((0.0, 0.0), (4.0, 4.0), (0.0, 4.0))
# Forces by the mesh of the reference, which takes minutes on a GPU.
REFERENCE = Path(__file__).with_name("paper_forces.csv")
COLUMNS = ("indenter", "x_mm", "y_mm", "depth_mm", "fx", "fy", "fz")
# Minimum depth for an error: at smaller depths, forces are a few hundredths of the largest.
SHALLOW_MM = 0.6

# Force of the indenter on the body (3,) [N], by indenter, x, y, depth [mm].
Forces = dict[tuple[str, float, float, float], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class TimedPress:
    """One indenter at one place, to all depths, in millimetres as in the file."""

    indenter: str
    x: float
    y: float
    depths: tuple[float, ...] = DEPTHS_MM

    def scene(self) -> Scene:
        """Return the scene of the press."""
        return Scene(
            named(self.indenter),
            press([depth * 1e-3 for depth in self.depths], at=(self.x * 1e-3, self.y * 1e-3)),
            effects=Effects(friction=Friction(FRICTION)),
        )


def paper_presses() -> list[TimedPress]:
    """Return 18 indenters at 9 places, each to 5 depths."""
    return [TimedPress(name, x, y) for name in NAMES for x in PLACES_MM for y in PLACES_MM]


def reference_presses() -> list[TimedPress]:
    """Return those of the presses whose forces are compared."""
    return [TimedPress(name, x, y) for name in NAMES for x, y in REFERENCE_AT]


def quick_presses() -> list[TimedPress]:
    """Return two smooth shapes at two places, each to two depths."""
    places = REFERENCE_AT[:2]
    return [TimedPress(name, x, y, (0.3, 0.6)) for name in ("sphere", "wave") for x, y in places]


def forces_of(presses: Sequence[TimedPress], outcomes: Sequence[Outcome]) -> Forces:
    """Return the forces of the presses that have a solution."""
    return {
        (one.indenter, one.x, one.y, depth): force
        for one, outcome in zip(presses, outcomes, strict=True)
        if isinstance(outcome, Result)
        # In the first frame the indenter only touches the surface.
        for depth, force in zip(one.depths, outcome.force[1:], strict=True)
    }


def extrapolated(fine: Forces, coarse: Forces, ratio: float) -> Forces:
    """Return the forces that both meshes have, extrapolated by the `ratio` of their spacings."""
    more = left_of_difference(ratio)
    return {
        key: force + more * (force - coarse[key]) for key, force in fine.items() if key in coarse
    }


def errors(forces: Forces, reference: Forces, from_mm: float = SHALLOW_MM) -> dict[str, Any]:
    """Return |F - Fref| / |Fref| over common presses, at depths of at least `from_mm`, in JSON.

    `compared` is the number of presses, `most` the 95th percentile.
    """
    both = [key for key in reference if key in forces and key[3] >= from_mm - 1e-9]
    if not both:
        return {"compared": 0, "mean": None, "most": None, "worst": None, "worst_at": ""}
    true = np.array([reference[key] for key in both])
    difference = np.array([forces[key] for key in both]) - true
    fraction = np.linalg.norm(difference, axis=1) / np.linalg.norm(true, axis=1)
    name, x, y, depth = both[int(fraction.argmax())]
    return {
        "compared": len({key[:3] for key in both}),
        "mean": float(fraction.mean()),
        "most": float(np.percentile(fraction, 95)),
        "worst": float(fraction.max()),
        "worst_at": f"{name} at ({x:g}, {y:g}) mm, {depth:g} mm deep",
    }


def write_forces(forces: Forces, path: Path = REFERENCE) -> None:
    """Write forces in [N] to seven digits."""
    lines = [",".join(COLUMNS)]
    for (name, *place), force in forces.items():
        numbers = [*(f"{one:g}" for one in place), *(f"{one:.7g}" for one in force)]
        lines.append(",".join([name, *numbers]))
    replace_file(path, ("\n".join(lines) + "\n").encode())


def read_forces(path: Path = REFERENCE) -> Forces:
    """Read the forces written by `write_forces`."""
    forces: Forces = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            name, *numbers = (row[column] for column in COLUMNS)
            x, y, depth, *force = map(float, numbers)
            forces[name, x, y, depth] = np.array(force)
    return forces
