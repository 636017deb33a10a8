"""Where markers lie: rows, staggered rows, rings and hexagons, all around the gel's middle."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sim.errors import SceneError
from sim.patterns.pattern import Place


def rows(columns: int, count: int, pitch: float, row_pitch: float | None = None) -> list[Place]:
    """`count` rows of `columns` markers, `pitch` apart along x and `row_pitch` along y [m]."""
    across = _centred(columns, pitch)
    return [(x, y) for y in _centred(count, row_pitch or pitch) for x in across]


def staggered(
    columns: int, count: int, pitch: float, row_pitch: float, *, shorter: bool
) -> list[Place]:
    """`count` rows, every other one aside by half a pitch [m].

    With `shorter` the rows that lie aside have a marker less and all rows are centred; otherwise
    all rows are alike and lie a quarter of the pitch to the left or to the right.
    """
    places = []
    for index, y in enumerate(_centred(count, row_pitch)):
        aside = index % 2 == 1
        if shorter:
            row = _centred(columns - aside, pitch)
        else:
            shift = pitch / 4 if aside else -pitch / 4
            row = [x + shift for x in _centred(columns, pitch)]
        places += [(x, y) for x in row]
    return places


def rings(counts: Sequence[int], spacing: float, *, middle: bool) -> list[Place]:
    """Rings about the middle, `spacing` [m] apart, of so many evenly spaced markers each.

    Every ring begins at an angle of its own, half a gap further for every other one, so that its
    markers do not line up with its neighbours'. `middle` adds one in the middle.
    """
    if any(count < 1 for count in counts):
        raise SceneError(f"rings: {tuple(counts)!r}; allowed: at least 1 marker each")
    places = [(0.0, 0.0)] if middle else []
    for index, count in enumerate(counts):
        radius = (index + 1) * spacing
        first = (index % 2) * math.pi / count
        turns = [first + 2 * math.pi * number / count for number in range(count)]
        places += [(radius * math.cos(turn), radius * math.sin(turn)) for turn in turns]
    return places


def hexagon(ring_count: int, pitch: float) -> list[Place]:
    """A triangular lattice of `pitch` [m] within a hexagon of so many rings about its middle.

    1 + 3 n (n + 1) places for n rings: 127 for 6.
    """
    reach = range(-ring_count, ring_count + 1)
    axial = [(q, r) for r in reach for q in reach if abs(q + r) <= ring_count]
    height = math.sqrt(3) / 2
    return [(pitch * (q + r / 2), pitch * r * height) for q, r in axial]


def turned(places: Sequence[Place], angle: float) -> list[Place]:
    """The places turned about the middle by `angle` [rad], anticlockwise."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return [(cosine * x - sine * y, sine * x + cosine * y) for x, y in places]


def _centred(count: int, pitch: float) -> list[float]:
    if count < 1:
        raise SceneError(f"markers in a row: {count!r}; allowed: at least 1")
    return [(index - (count - 1) / 2) * pitch for index in range(count)]
