"""The vocabulary of a plan: points, targets, moves.

Frame: the contact frame. Its origin lies on the untouched surface of the sensor at its centre, z
points out of the sensor, so an indentation is a negative z.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

# Names of the phases; their index is the code that is stored.
PHASES = ("normal_inc", "shear_inc", "shear_dec", "normal_dec")

# A position of the indenter's tip in the contact frame [m].
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Target:
    """One press: where, how deep, and in which direction it is sheared."""

    index: int
    """Its place in the plan, from 0."""
    point: int
    """Number of the contact point, from 1 as in the paper."""
    depth: float
    """Indentation at the bottom [m], positive."""
    direction: int
    """Shear direction, 0 along +x and counter-clockwise; -1 for a press without shear."""
    origin: Point
    """p0, clear of the surface [m]."""
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
    """Where it begins [m]."""
    end: Point
    """Where it ends [m]."""


class Plan(Protocol):
    """A frozen spec: sized and iterable by target, and each target by its moves."""

    @property
    def kind(self) -> str:
        """The word that names this spec in a bench file and in a session."""

    def __len__(self) -> int:
        """Number of targets."""

    def targets(self) -> Iterator[Target]:
        """All targets in the order they are pressed."""

    def moves(self, target: Target) -> tuple[Move, ...]:
        """The recorded moves of one target, each beginning where the one before it ended."""


def check_positive(spec: object, names: Sequence[str]) -> None:
    """Refuse a spec with a field that is not a finite number above zero.

    Raises:
        ValueError: Names the field, what was found and what is allowed.
    """
    for name in names:
        value = getattr(spec, name)
        if not 0 < value < float("inf"):
            raise ValueError(f"{name}: {value!r}; allowed: a finite number above 0")
