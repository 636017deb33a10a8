"""Presses straight down and up again: for curves, surfaces, latency, and a sensor's first press."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from trajectories.moves import (
    Move,
    Point,
    Target,
    check_positive,
    dome_height,
    down_and_up,
)

# First press: height of the press in the air and depth of the touch [m].
_AIR, _TOUCH = 1e-3, 0.05e-3
# Depths of the presses after them, as fractions of the planned one.
_STEPS = (0.1, 0.25, 0.5, 1.0)


class StraightPresses:
    """Base of plans whose targets have a move down and a move up."""

    __slots__ = ()

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the move down and the move up."""
        return down_and_up(target)


def _press(index: int, depth: float, origin: Point, bottom: Point, point: int = 1) -> Target:
    return Target(index, point, depth, -1, origin, bottom, bottom)


@dataclass(frozen=True, slots=True)
class ForceDepth(StraightPresses):
    """Loading and unloading at the centre, `repeats` times; each repeat is one target.

    The paper presses the prism 3 times to 1.2 mm (homogeneous), 1.0 mm (GelSight, uSkin) or 4.5 mm
    (TacPalm), and treats loading and unloading separately, since they differ by hysteresis.

    Raises:
        ValueError: A length that is not positive, or less than one repeat.
    """

    KIND: ClassVar[str] = "force_depth"

    depth_max: float = field(metadata={"unit": "mm", "plausible": (0.02, 50)})
    """Deepest indentation [m]."""
    repeats: int = 3
    """Number of presses."""
    clearance: float = field(default=0.3e-3, metadata={"unit": "mm", "plausible": (0.01, 50)})
    """Height of p0 above the undeformed surface [m]."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        check_positive(self, ("depth_max", "clearance"))
        if self.repeats < 1:
            raise ValueError(f"repeats: {self.repeats!r}; allowed: 1 or more")

    def __len__(self) -> int:
        """Return the number of targets."""
        return self.repeats

    def targets(self) -> Iterator[Target]:
        """Yield the same press `repeats` times."""
        origin = (0.0, 0.0, self.clearance)
        bottom = (0.0, 0.0, -self.depth_max)
        for index in range(self.repeats):
            yield _press(index, self.depth_max, origin, bottom)


@dataclass(frozen=True, slots=True)
class FirstPress(StraightPresses):
    """Presses of growing depth: in the air, a touch, then fractions of the planned depth.

    Raises:
        ValueError: A length that is not positive.
    """

    KIND: ClassVar[str] = "first_press"

    depth_max: float = field(metadata={"unit": "mm"})
    """Depth of the last press [m]."""
    clearance: float = field(default=2e-3, metadata={"unit": "mm"})
    """Height of p0 above the undeformed surface [m]."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        check_positive(self, ("depth_max", "clearance"))

    @property
    def depths(self) -> tuple[float, ...]:
        """Depth of each press [m]; negative in the air."""
        steps = [step * self.depth_max for step in _STEPS]
        return (-_AIR, min(_TOUCH, steps[0]), *steps)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each press, for display."""
        return ("air", "touch", *(f"{100 * step:.0f} %" for step in _STEPS))

    def __len__(self) -> int:
        """Return the number of presses."""
        return len(self.depths)

    def targets(self) -> Iterator[Target]:
        """Yield the presses from the air to the full depth."""
        origin = (0.0, 0.0, self.clearance)
        for index, depth in enumerate(self.depths):
            bottom = (0.0, 0.0, -depth)
            yield _press(index, max(depth, 0.0), origin, bottom)


@dataclass(frozen=True, slots=True)
class Touch(StraightPresses):
    """Straight moves down at each point, `repeats` times, to be ended by the guard's soft limit.

    Raises:
        ValueError: A length that is not positive, no repeat, or a point that is not in the pattern.
    """

    KIND: ClassVar[str] = "touch"

    travel: float = field(metadata={"unit": "mm"})
    """Depth below the assumed surface at which an approach without contact ends [m]."""
    clearance: float = field(default=1e-3, metadata={"unit": "mm"})
    """Height above the assumed surface at which each approach begins [m]."""
    repeats: int = 3
    """Number of approaches per point."""
    points: tuple[int, ...] = (1,)
    """Points to approach: 1 is the centre, 2 to 5 are the corners, counter-clockwise."""
    step_x: float = field(default=2e-3, metadata={"unit": "mm"})
    """Distance of the corners from the centre along x [m]."""
    step_y: float = field(default=2e-3, metadata={"unit": "mm"})
    """Distance of the corners from the centre along y [m]."""
    dome_radius: float | None = field(
        default=None, metadata={"unit": "mm", "stored": "unless default"}
    )
    """Radius of the sensor's spherical top, its apex at the origin [m]; None: flat."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        check_positive(self, ("travel", "clearance", "step_x", "step_y"))
        if self.repeats < 1:
            raise ValueError(f"repeats: {self.repeats!r}; allowed: 1 or more")
        if not self.points or any(point not in range(1, 6) for point in self.points):
            raise ValueError(f"points: {self.points!r}; allowed: numbers from 1 to 5")

    def __len__(self) -> int:
        """Return the number of approaches."""
        return len(self.points) * self.repeats

    def position(self, point: int) -> tuple[float, float]:
        """Return the position of point `point` (1 to 5) [m]."""
        sign_x, sign_y = ((0, 0), (1, 1), (-1, 1), (-1, -1), (1, -1))[point - 1]
        return (sign_x * self.step_x, sign_y * self.step_y)

    def targets(self) -> Iterator[Target]:
        """Yield the targets point by point, each `repeats` times."""
        for index in range(len(self)):
            point = self.points[index // self.repeats]
            x, y = self.position(point)
            surface = dome_height(self.dome_radius, x, y)
            bottom = (x, y, surface - self.travel)
            yield _press(index, self.travel, (x, y, surface + self.clearance), bottom, point)


@dataclass(frozen=True, slots=True)
class Taps(StraightPresses):
    """`count` taps at the centre; the same seed gives the same taps.

    They differ in height and depth, so that no two intervals are equal: a regular rhythm would look
    the same one period later.

    Raises:
        ValueError: A length that is not positive, heights that do not ascend, or no tap.
    """

    KIND: ClassVar[str] = "taps"

    depth_max: float = field(metadata={"unit": "mm"})
    """Deepest tap [m]; the lightest reaches 0.7 of it."""
    count: int = 12
    """Number of taps."""
    height_min: float = field(default=0.3e-3, metadata={"unit": "mm"})
    """Least height above the surface between taps [m]."""
    height_max: float = field(default=2.0e-3, metadata={"unit": "mm"})
    """Largest height above the surface between taps [m]."""
    seed: int = 0
    """Seed of heights and depths."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        check_positive(self, ("depth_max", "height_min", "height_max"))
        if self.height_max <= self.height_min:
            raise ValueError(f"height_max: {self.height_max!r}; allowed: above height_min")
        if self.count < 1:
            raise ValueError(f"count: {self.count!r}; allowed: 1 or more")

    def __len__(self) -> int:
        """Return the number of taps."""
        return self.count

    def _drawn(self) -> tuple[list[float], list[float]]:
        rng = random.Random(self.seed)
        heights = [rng.uniform(self.height_min, self.height_max) for _ in range(self.count + 1)]
        return heights, [self.depth_max * rng.uniform(0.7, 1.0) for _ in range(self.count)]

    def targets(self) -> Iterator[Target]:
        """Yield one target per tap, each from its own height."""
        heights, depths = self._drawn()
        for index, depth in enumerate(depths):
            bottom = (0.0, 0.0, -depth)
            yield _press(index, depth, (0.0, 0.0, heights[index]), bottom)

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the move down, and the move up to the start of the next tap."""
        rise = (0.0, 0.0, self._drawn()[0][target.index + 1])
        return down_and_up(target, rise)
