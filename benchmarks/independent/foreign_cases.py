"""Presses without axial symmetry, for GetFEM (`getfem_press`). Lengths are in mm.

Plain values and only the standard library, because GetFEM runs in a separate interpreter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Shape = Literal["spheres", "punch", "bar", "box", "triangle"]
Zone = tuple[float, float, float]


@dataclass(frozen=True)
class ForeignCase:
    """One press; every point of `path` is reported."""

    name: str
    shape: Shape
    measures: tuple[float, ...]
    """[mm]. `spheres`: radius, and x of the centres of two (without them: one in the middle).
    `punch`: radius, edge radius. `bar`: radius, length, edge radius; `box`: width, length, edge
    radius. `triangle`: x and y of three corners, counter-clockwise, edge radius."""
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

    @property
    def text(self) -> str:
        """The measures, separated by spaces."""
        return " ".join(f"{measure:g}" for measure in self.measures)


def _round(reach: float, size: float) -> tuple[Zone, ...]:
    return ((0.0, reach, size),)


CASES: tuple[ForeignCase, ...] = (
    ForeignCase(
        "sphere 4 near the edge",
        "spheres",
        (4.0,),
        ((8.0, 0.0, 0.5), (8.0, 0.0, 0.8)),
        ((6.0, 10.0, 0.33),),
        _round(2.1, 0.33),
        mirrors="y",
    ),
    ForeignCase(
        "two spheres 2",
        "spheres",
        (2.0, -2.5, 2.5),
        ((0.0, 0.0, 0.3), (0.0, 0.0, 0.6)),
        ((1.3, 3.7, 0.2),),
        _round(1.2, 0.2),
        mirrors="xy",
    ),
    ForeignCase(
        "sphere 4 on a thin gel",
        "spheres",
        (4.0,),
        ((0.0, 0.0, 0.05), (0.0, 0.0, 0.2)),
        _round(1.4, 0.14),
        _round(1.4, 0.14),
        size=(10.0, 10.0, 0.8),
        mirrors="xy",
    ),
    ForeignCase(
        "sphere 3 on a dome",
        "spheres",
        (3.0,),
        ((0.0, 0.0, 0.5), (0.0, 0.0, 1.0)),
        _round(1.9, 0.21),
        _round(1.9, 0.21),
        size=(16.0, 16.0, 4.0),
        dome=60.0,
        mirrors="xy",
    ),
    ForeignCase(
        "box 4 x 6",
        "box",
        (4.0, 6.0, 0.5),
        ((0.0, 0.0, 0.3),),
        ((1.5, 2.1, 0.12),),
        ((2.5, 3.1, 0.12),),
        mirrors="xy",
    ),
    ForeignCase(
        "blade 0.5 x 12",
        "box",
        (0.5, 12.0, 0.2),
        ((0.0, 0.0, 0.05), (0.0, 0.0, 0.1)),
        ((0.0, 0.25, 0.035),),
        ((5.7, 6.1, 0.1),),
        mirrors="xy",
    ),
    ForeignCase(
        "bar 2 x 6",
        "bar",
        (2.0, 6.0, 0.5),
        ((0.0, 0.0, 0.3), (0.0, 0.0, 0.6)),
        _round(1.3, 0.2),
        ((2.5, 3.1, 0.12),),
        mirrors="xy",
    ),
    ForeignCase(
        "punch 3 tilted by 5 degrees",
        "punch",
        (3.0, 0.5),
        ((0.0, 0.0, 0.2), (0.0, 0.0, 0.5)),
        ((-3.1, -2.3, 0.15), (-3.1, 0.5, 0.3), (0.5, 3.1, 0.4)),
        ((0.0, 3.1, 0.28),),
        tilt=(0.0, -5.0),
        mirrors="y",
    ),
    ForeignCase(
        "triangle",
        "triangle",
        (2.8, 0.0, -1.4, 2.4, -1.4, -2.4, 0.5),
        ((0.0, 0.0, 0.3),),
        ((-1.5, -0.9, 0.16), (-1.5, 2.7, 0.22)),
        ((0.0, 2.4, 0.19),),
        mirrors="y",
    ),
    ForeignCase(
        "bar 2 x 6 tilted by 4 degrees",
        "bar",
        (2.0, 6.0, 0.5),
        ((0.0, 0.0, 0.3), (0.0, 0.0, 0.6)),
        _round(1.2, 0.2),
        ((-3.2, 3.2, 0.4), (2.4, 3.1, 0.18)),
        tilt=(-4.0, 0.0),
        mirrors="x",
    ),
    ForeignCase(
        "sphere 4 sheared, mu 0.5",
        "spheres",
        (4.0,),
        ((0.0, 0.0, 0.6), (0.3, 0.0, 0.6), (0.6, 0.0, 0.6)),
        ((-1.8, 2.4, 0.35),),
        _round(1.8, 0.35),
        friction=0.5,
        mirrors="y",
    ),
    ForeignCase(
        "sphere 4 beyond the rim",
        "spheres",
        (4.0,),
        ((9.5, 0.0, 0.3), (9.5, 0.0, 0.6)),
        ((7.7, 10.0, 0.3),),
        _round(2.1, 0.3),
        mirrors="y",
    ),
)
