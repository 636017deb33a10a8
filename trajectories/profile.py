"""Duration of straight moves with the trapezoidal speed profile of a robot controller."""

from __future__ import annotations

import math

from trajectories.moves import Point


def distance(start: Point, end: Point) -> float:
    """Return the straight distance between two points [m]."""
    return math.dist(start, end)


def move_duration(length: float, speed: float, acceleration: float) -> float:
    """Return the duration of a move from rest to rest [s].

    Speed rises at `acceleration`, stays at `speed` and falls at `acceleration`; a move shorter than
    speed^2 / acceleration never reaches `speed`.

    Args:
        length: Length of the move [m].
        speed: Highest speed [m/s].
        acceleration: Acceleration and deceleration [m/s^2].
    """
    if length <= speed * speed / acceleration:
        return 2 * math.sqrt(length / acceleration)
    return length / speed + speed / acceleration
