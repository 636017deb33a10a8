"""The presses solved by other methods than those of `sim`, on two meshes each."""

import functools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.independent import profile
from benchmarks.independent.axisymmetric import Answer, AxisymmetricPress, Layer, NotSolved
from benchmarks.independent.mesh import Fine, layer_grid
from benchmarks.independent.presses import MM, MODULUS, Press

ROOT = Path(__file__).parents[2]
# Environment variable with the interpreter that has GetFEM, and the one for which Debian and Ubuntu
# install `python3-getfem`.
PYTHON, SYSTEM = "FOREIGN_PYTHON", "/usr/bin/python3"
# Factors on the element sizes of GetFEM's meshes.
GETFEM_FINE, GETFEM_COARSE = 1.3, 2.0


@dataclass(frozen=True)
class Fineness:
    """Resolution at which an axisymmetric press is solved."""

    elements: int
    """Number of elements along the radius of the contact."""
    growth: float
    """Growth of elements with the distance from the contact."""
    steps: int
    """Number of tip steps, with friction; half as many without."""


FINE, COARSE = Fineness(28, 0.22, 40), Fineness(14, 0.36, 20)


def solved(press: Press) -> dict[str, Any]:
    """Return `forces_n` and `uncertainty_percent` of a press, in JSON; of fewer points if it fails.

    They are rounded to the digits that are stored.
    """
    pairs = by_axisymmetric(press) if press.axisymmetric else by_getfem(press)
    return {
        "forces_n": [[float(f"{axis:.6g}") for axis in force] for force, _ in pairs],
        "uncertainty_percent": [round(100 * error, 4) for _, error in pairs],
    }


# Axisymmetric elements.


def by_axisymmetric(press: Press) -> list[tuple[Sequence[float], float]]:
    """Return the force at each depth, and its uncertainty as a fraction.

    This is the sum of the difference from a mesh with half as many elements along the contact (and,
    with friction, half as many steps); half the difference between a disc around the square body
    and one inside it (the reference is the disc of equal area); and twice the penetration that is
    left of the contact, over the depth.
    """
    half = press.size[0] / 2 * MM
    equal = 2 * half / math.sqrt(math.pi)
    # Friction hardly changes the effect of the side, and needs many steps.
    slippery = replace(press, friction=0.0)
    try:
        fine, coarse = answers(press, equal, FINE), answers(press, equal, COARSE)
        inside, around = (answers(slippery, half * size, COARSE) for size in (1.0, math.sqrt(2)))
    except NotSolved:
        return []
    pairs: list[tuple[Sequence[float], float]] = []
    for best, rough, less, more in zip(fine, coarse, inside, around, strict=True):
        side = abs(more.force - less.force) / best.force / 2
        error = abs(rough.force / best.force - 1) + side + 2 * best.penetration
        pairs.append(((0.0, 0.0, -best.force), error))
    return pairs


def answers(press: Press, radius: float, fineness: Fineness) -> list[Answer]:
    """Solve a press into a disc of `radius` [m]; NotSolved if Newton's method does not converge."""
    layer = Layer(radius, press.size[2] * MM, MODULUS, press.poisson)
    zones = fine_zones(press, fineness.elements)
    grid = layer_grid(radius, layer.thickness, zones, growth=fineness.growth)
    low, high = touched(press, max(press.depths))
    wide = (high - low) / (1 if low == 0 else 2) * MM
    solver = AxisymmetricPress(layer, profile_of(press), grid, press.friction, wide)
    steps = fineness.steps if press.friction else fineness.steps // 2
    return solver.run([depth * MM for depth in press.depths], way(press, steps))


def profile_of(press: Press) -> profile.Profile:
    """Return the outline of the indenter."""
    lengths = [measure * MM for measure in press.measures]
    if press.shape == "cone":
        return profile.cone(math.radians(press.measures[0]), lengths[1])
    make: dict[str, Callable[..., profile.Profile]] = {
        "sphere": profile.sphere,
        "punch": profile.punch,
        "torus": profile.torus,
        "tube": profile.tube,
    }
    return make[press.shape](*lengths)


def touched(press: Press, depth: float) -> tuple[float, float]:
    """Return approximate inner and outer contact radii at `depth` [mm], for mesh grading."""
    first, last, thickness = press.measures[0], press.measures[-1], press.size[2]
    match press.shape:
        case "sphere":
            return 0.0, _cap(first, depth, thickness)
        case "torus":
            half = _cap(last, depth, thickness)
            return first - half, first + half
        case "cone":
            cap = _cap(last, min(depth, last), thickness)
            return 0.0, max(0.8 * math.tan(math.radians(first)) * depth, cap)
        case "tube":
            return press.measures[1], first
    return 0.0, first


def _cap(radius: float, depth: float, thickness: float) -> float:
    """Return a sphere's contact radius between (R d)^1/2 (half-space) and (2 R d)^1/2 (layer)."""
    half_space = math.sqrt(radius * depth)
    grown = min(1.0, 0.5 * half_space / thickness)
    return min(half_space * math.sqrt(1 + grown), 0.98 * radius)


def fine_zones(press: Press, elements: int) -> list[Fine]:
    """Return the refined zones of the mesh, with `elements` along the radius of the contact."""
    least, deepest = min(press.depths), max(press.depths)
    low, high = touched(press, deepest)
    if press.shape in ("sphere", "cone", "torus"):
        wide = (high - low) / (2 if press.shape == "torus" else 1)
        zones = [Fine(low * MM, high * MM, wide / elements * MM)]
        if low == 0:
            # A contact that is still small has half as many elements along its radius.
            small = touched(press, least)[1]
            zones.append(Fine(0.0, small * MM, small / elements * 2 * MM))
        return zones
    edge = press.measures[-1]
    # If only a small part of an edge touches, the elements are sized for that part.
    held = math.sqrt(edge**2 - max(0.0, edge - deepest) ** 2)
    size = held / elements * 2.5
    spots = [Fine((high - edge) * MM, (high + 0.3 * edge) * MM, size * MM)]
    if press.shape == "tube":
        spots.append(Fine((low - 0.3 * edge) * MM, (low + edge) * MM, size * MM))
    return spots


def way(press: Press, steps: int) -> list[float]:
    """Return intermediate depths [m] of a press, at which the contact grows about evenly."""
    power = 2 if press.shape in ("sphere", "torus") else 1
    deepest = max(press.depths) * MM
    return [deepest * (step / steps) ** power for step in range(1, steps + 1)]


# GetFEM.


@functools.cache
def interpreter() -> str | None:
    """Return an interpreter that can import GetFEM, or None."""
    for candidate in (os.environ.get(PYTHON), sys.executable, SYSTEM):
        if candidate and Path(candidate).exists():
            tried = [candidate, "-c", "import getfem"]
            if subprocess.run(tried, capture_output=True, check=False).returncode == 0:
                return candidate
    return None


def by_getfem(press: Press) -> list[tuple[Sequence[float], float]]:
    """Return the force at each point that was reached, and its difference from a coarser mesh.

    The difference is that of vectors, as a fraction.
    """
    coarse, fine = (_points(press, scale) for scale in (GETFEM_COARSE, GETFEM_FINE))
    return [
        (best, math.dist(rough, best) / math.hypot(*best))
        for rough, best in zip(coarse, fine, strict=False)
    ]


def _points(press: Press, scale: float) -> list[list[float]]:
    """Return the force at each point of the path that GetFEM reached."""
    done = subprocess.run(
        [interpreter() or "", "-m", "benchmarks.independent.getfem_press", press.name, f"{scale}"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
