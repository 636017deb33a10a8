"""Points, targets and moves: the elements of a plan.

Frame: the contact frame. Its origin is on the undeformed surface of the sensor at its centre; z
points out of the sensor, so an indentation of a flat sensor is a negative z.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

# Names of the phases; the index is the stored code.
PHASES = ("normal_inc", "shear_inc", "shear_dec", "normal_dec")

# A position of the indenter's tip in the contact frame [m].
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Target:
    """One press: position, depth and shear direction."""

    index: int
    """Index in the plan, from 0."""
    point: int
    """Number of the contact point, from 1 as in the paper."""
    depth: float
    """Indentation at the bottom [m], positive."""
    direction: int
    """Shear direction, 0 along +x and counter-clockwise; -1 for a press without shear."""
    origin: Point
    """p0, above the surface [m]."""
    bottom: Point
    """p1, straight below p0 at full depth [m]."""
    sheared: Point
    """p2, p1 moved sideways [m]; equal to p1 for a press without shear."""


@dataclass(frozen=True, slots=True)
class Move:
    """One straight, recorded move of a target."""

    target: int
    """Index of its target."""
    phase: int
    """Index into PHASES."""
    start: Point
    """Start point [m]."""
    end: Point
    """End point [m]."""


class Plan(Protocol):
    """Interface of a frozen spec, which yields its targets and the moves of each target."""

    KIND: ClassVar[str]
    """Name of the spec's type in bench files and sessions."""

    def __len__(self) -> int:
        """Return the number of targets."""

    def targets(self) -> Iterator[Target]:
        """Yield all targets in the order in which they are pressed."""

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the recorded moves of one target, each starting at the end of the previous one."""


def down_and_up(target: Target, end: Point | None = None) -> tuple[Move, ...]:
    """Return the moves of a press without shear: down, and up to `end`; by default to its p0."""
    up = target.origin if end is None else end
    return (
        Move(target.index, PHASES.index("normal_inc"), target.origin, target.bottom),
        Move(target.index, PHASES.index("normal_dec"), target.bottom, up),
    )


def dome_height(radius: float | None, x: float, y: float) -> float:
    """Return the height of a sensor's undeformed top at (x, y) [m], 0 at the centre.

    Args:
        radius: Radius of the spherical top, its apex at the origin [m]; None: flat.
        x: Place in the contact frame [m]; beyond the dome the height is that of its rim.
        y: Place in the contact frame [m].
    """
    if radius is None:
        return 0.0
    return math.sqrt(max(radius * radius - x * x - y * y, 0.0)) - radius


def check_positive(spec: object, names: Sequence[str]) -> None:
    """Reject a spec with a field that is not a finite number above zero."""
    for name in names:
        value = getattr(spec, name)
        if not 0 < value < float("inf"):
            raise ValueError(f"{name}: {value!r}; allowed: a finite number above 0")
