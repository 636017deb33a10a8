"""The patterns by name: the paper's 12 simulated ones, its GelSights, TacPalm's pins.

Of the authors' textures only the number of markers is known (225, 100, 80, 99; 320, 115, 111, 124;
245, 100, 81, 81, over the whole gel of 20 x 20 mm). Everything else here is assumed: "array" is
rows and columns, "circle" is rings of discs about the middle, "diamond" is diamonds in lattices
that are turned or staggered; markers are 25 to 45 % as wide as they are apart, and rows do not lie
across the upper or lower border of the paper's image.

Of the real GelSights the markers' pitch of 2.4 mm is known (5 rows of 7 in view) and that two of
them had their elastomer moved or turned; shape, size and the amount are assumed. Of the GelSight
that is compared with other sensors, that 56 markers are in view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from sim.errors import SceneError
from sim.patterns.layouts import hexagon, rings, rows, staggered, turned
from sim.patterns.pattern import Pattern, Place, Shape

MM = 1e-3
MOVED: tuple[Place, float] = ((0.55 * MM, -0.4 * MM), math.radians(3.0))
"""Shift [m] and turn [rad] that make Array-II of Array-I."""
MOVED_CIRCLE: tuple[Place, float] = ((-0.45 * MM, 0.5 * MM), math.radians(-4.0))
"""The same for the circles."""


def _pattern(name: str, shape: Shape, size_mm: float, places: Sequence[Place]) -> Pattern:
    return Pattern(name, shape, size_mm * MM, tuple(places))


_ARRAY = _pattern("Array-I", "disc", 0.70, rows(7, 7, 2.4 * MM))
_CIRCLE = _pattern("Circle-I", "disc", 0.70, rings((6, 12, 18, 24), 2.1 * MM, middle=True))

_PATTERNS = (
    _pattern("Array1", "disc", 0.50, rows(15, 15, 1.30 * MM)),
    _pattern("Array2", "square", 0.70, rows(10, 10, 1.95 * MM)),
    _pattern("Array3", "disc", 0.80, rows(10, 8, 1.90 * MM, 2.10 * MM)),
    _pattern("Array4", "square", 0.50, rows(11, 9, 1.75 * MM, 1.90 * MM)),
    _pattern(
        "Circle1",
        "disc",
        0.36,
        rings((6, 12, 17, 23, 29, 35, 41, 46, 52, 58), 0.96 * MM, middle=True),
    ),
    _pattern("Circle2", "disc", 0.55, rings((4, 8, 12, 16, 20, 25, 29), 1.32 * MM, middle=True)),
    _pattern("Circle3", "disc", 0.66, rings((5, 11, 16, 21, 26, 32), 1.55 * MM, middle=False)),
    _pattern("Circle4", "disc", 0.42, rings((6, 12, 18, 23, 29, 35), 1.55 * MM, middle=True)),
    _pattern("Diamond1", "diamond", 0.45, staggered(18, 14, 1.08 * MM, 1.38 * MM, shorter=True)),
    _pattern("Diamond2", "diamond", 0.60, turned(rows(10, 10, 1.46 * MM), math.pi / 4)),
    _pattern("Diamond3", "diamond", 0.72, turned(rows(9, 9, 1.63 * MM), math.pi / 4)),
    _pattern("Diamond4", "diamond", 0.85, staggered(9, 9, 2.08 * MM, 1.88 * MM, shorter=False)),
    _ARRAY,
    _ARRAY.moved(*MOVED, name="Array-II"),
    _CIRCLE,
    _CIRCLE.moved(*MOVED_CIRCLE, name="Circle-II"),
    _pattern("Diamond-I", "diamond", 0.80, staggered(6, 11, 3.4 * MM, 1.7 * MM, shorter=True)),
    _pattern("GelSight", "disc", 0.60, rows(8, 7, 1.75 * MM)),
    _pattern("TacPalm", "disc", 1.10, hexagon(6, 2.6 * MM)),
)
_BY_NAME = {pattern.name: pattern for pattern in _PATTERNS}

NAMES = tuple(_BY_NAME)
SIMULATED = NAMES[:12]
"""The paper's 12 simulated patterns."""
HOMOGENEOUS = NAMES[12:17]
"""The five GelSights of the paper's homogeneous test."""


def named(name: str) -> Pattern:
    """The pattern of that name.

    Raises:
        SceneError: A name that is not there.
    """
    if name not in _BY_NAME:
        raise SceneError(f"pattern: {name!r}; allowed: {', '.join(NAMES)}")
    return _BY_NAME[name]
