"""Presses without axial symmetry, for GetFEM (`getfem_press`), of `foreign_cases.json`; in mm.

Plain values and only the standard library, because GetFEM runs in a separate interpreter.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Shape = Literal["spheres", "punch", "bar", "box"]
Zone = tuple[float, float, float]


@dataclass(frozen=True)
class ForeignCase:
    """One press; every point of `path` is reported."""

    name: str
    shape: Shape
    measures: tuple[float, ...]
    """[mm]. `spheres`: radius, and x of the centres of two (without them: one in the middle).
    `punch`: radius, edge radius. `bar`: radius, length, edge radius; `box`: width, length, edge
    radius."""
    path: tuple[tuple[float, float, float], ...]
    """x, y and depth of the tip [mm]."""
    x_zones: tuple[Zone, ...]
    """Element sizes along x: from, to, size [mm] of the fine mesh."""
    y_zones: tuple[Zone, ...]
    """The same for y."""
    size: tuple[float, float, float] = (20.0, 20.0, 4.0)
    """Size of the body along x, y and z [mm]."""
    dome: float | None = None
    """Radius of the body's top [mm]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Tilt of the indenter about x and y [degrees]."""
    friction: float = 0.0
    mirrors: str = ""
    """`x`: the scene is symmetric about the plane x = 0, so half of it is solved; `y`, `xy`
    likewise."""
    modulus: float = 0.145e6
    """[Pa]."""
    poisson: float = 0.45


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


CASES: tuple[ForeignCase, ...] = tuple(
    ForeignCase(**{name: _tuples(value) for name, value in case.items()})
    for case in json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
)
