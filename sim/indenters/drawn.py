"""Randomly drawn indenters, for training on more shapes than the 18 with names.

`drawn-17` is the same indenter wherever it is named: the number is the seed of its draws. Sizes are
those of the 18: 2 to 14 mm across, on a body without contact beyond 8 mm from the axis.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sim.errors import SceneError
from sim.indenters import shapes
from sim.indenters.indenter import Indenter

_PREFIX = "drawn-"
# Numbers of drawn indenters are below this.
DRAWN_MOST = 1000
_MM = 1e-3
# Least and greatest edge radius [m]: sharp edges never converge; half of the 18 have 0.3 mm.
_EDGES = 0.2 * _MM, 0.5 * _MM

_Random = np.random.Generator


def indenter_of(name: str, edge_radius: float | None = None) -> Indenter:
    """Return a named or a drawn indenter; `edge_radius` [m] replaces its own.

    Raises:
        SceneError: The name is unknown, or the edge radius does not fit the shape.
    """
    if name in shapes.NAMES:
        return shapes.named(name, edge_radius)
    indenter = _drawn(number_of(name))
    return indenter if edge_radius is None else replace(indenter, edge_radius=edge_radius)


def is_indenter(name: str) -> bool:
    """Return True for a name that `indenter_of` accepts."""
    digits = name.removeprefix(_PREFIX)
    drawn = digits != name and digits.isdecimal() and str(int(digits)) == digits
    return name in shapes.NAMES or (drawn and int(digits) < DRAWN_MOST)


def drawn_name(number: int) -> str:
    """Return the name of a drawn indenter."""
    return f"{_PREFIX}{number}"


def number_of(name: str) -> int:
    """Return the number of a drawn indenter.

    Raises:
        SceneError: It is not a name of one.
    """
    if name in shapes.NAMES or not is_indenter(name):
        allowed = f"{', '.join(shapes.NAMES)}, {drawn_name(0)} to {drawn_name(DRAWN_MOST - 1)}"
        raise SceneError(f"indenter: {name!r}; allowed: {allowed}")
    return int(name.removeprefix(_PREFIX))


def _drawn(number: int) -> Indenter:
    random = np.random.default_rng([number, 0x1DE])
    make = _FAMILIES[int(random.integers(len(_FAMILIES)))]
    indenter = replace(make(random), name=drawn_name(number))
    edge = float(random.uniform(*_EDGES))
    if indenter.sharpest == 0.0:
        indenter = replace(indenter, edge_radius=min(edge, 0.8 * indenter.edge_radius_max))
    return indenter


def _mm(random: _Random, low: float, high: float) -> float:
    """Return a length [m] between two in mm, evenly distributed in its logarithm."""
    return _MM * math.exp(random.uniform(math.log(low), math.log(high)))


def _tube(random: _Random) -> Indenter:
    inner = _mm(random, 1.2, 3.2)
    return shapes.tube(inner + _mm(random, 0.8, 2.0), inner)


def _torus(random: _Random) -> Indenter:
    ring = _mm(random, 2.0, 4.5)
    return shapes.torus(ring, min(_mm(random, 0.8, 2.5), 0.9 * ring))


def _polygon(random: _Random) -> Indenter:
    """Return a flat punch whose 3 to 8 corners lie at random distances around its axis."""
    corners = int(random.integers(3, 9))
    turns = (np.arange(corners) + random.uniform(-0.3, 0.3, corners)) * math.tau / corners
    away = _mm(random, 2.2, 4.0) * random.uniform(0.6, 1.0, corners)
    vertices = np.stack([away * np.cos(turns), away * np.sin(turns), 0 * away], axis=1)
    return shapes.extruded(vertices.reshape(-1).tolist())


def _dots(random: _Random) -> Indenter:
    """Return 2 to 6 hemispheres on a circle, on a plate above their tips."""
    count, radius = int(random.integers(2, 7)), _mm(random, 0.8, 2.0)
    away = max(_mm(random, 2.0, 4.5), 1.3 * radius / math.sin(math.pi / count))
    begin = random.uniform(0, math.tau)
    drop, width = min(radius, 1 * _MM), 2 * (away + radius) + 1 * _MM
    return shapes.dots_on_plate(count, radius, away, begin, drop=drop, width=width)


_FAMILIES: tuple[Callable[[_Random], Indenter], ...] = (
    lambda random: shapes.sphere(_mm(random, 2.0, 8.0)),
    lambda random: shapes.flat_punch(_mm(random, 1.5, 4.5)),
    lambda random: shapes.cone(math.radians(random.uniform(20, 65)), _mm(random, 0.4, 1.5)),
    lambda random: shapes.box(_mm(random, 1.5, 9.0), _mm(random, 3.0, 14.0)),
    lambda random: shapes.bar(_mm(random, 1.5, 5.0), _mm(random, 4.0, 14.0)),
    _tube,
    _torus,
    _polygon,
    _dots,
)
