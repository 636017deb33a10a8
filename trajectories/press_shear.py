"""Algorithm 1 of the paper: press, shear, shear back, release, at every depth and direction.

For each of the contact points and each target (depth x direction) the tip goes
p0 -> p1 -> p2 -> p1 -> p0: straight down, sideways, back, straight up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from trajectories.moves import Move, Point, Target, check_positive


@dataclass(frozen=True, slots=True)
class PressShear:
    """Press-shear targets on a five-point pattern.

    The counts are those of the paper: five points, four depths and twelve directions (30 deg) give
    240 targets, eight directions (45 deg) give 160, one point alone gives 48.

    Raises:
        ValueError: A length that is not positive, a depth that is not a whole number of steps, an
            angle that does not divide the circle, or a point that is not in the pattern.
    """

    KIND: ClassVar[str] = "press_shear"

    step_x: float = field(metadata={"unit": "mm", "plausible": (0.05, 200)})
    """Distance of the outer points from the centre along x [m]."""
    step_y: float = field(metadata={"unit": "mm", "plausible": (0.05, 200)})
    """Distance of the outer points from the centre along y [m]."""
    depth_step: float = field(metadata={"unit": "mm", "plausible": (0.005, 50)})
    """Distance between depths, and the first depth [m]."""
    depth_max: float = field(metadata={"unit": "mm", "plausible": (0.02, 50)})
    """Deepest indentation [m]."""
    angle_step: float = field(metadata={"unit": "deg", "plausible": (2, 360)})
    """Angle between shear directions [rad]."""
    shear: float = field(metadata={"unit": "mm", "plausible": (0.01, 50)})
    """Length of the sideways move [m]."""
    clearance: float = field(default=0.3e-3, metadata={"unit": "mm", "plausible": (0.01, 50)})
    """Height of p0 above the undeformed surface [m]."""
    points: tuple[int, ...] = (1, 2, 3, 4, 5)
    """Points to press: 1 is the centre, 2 to 5 are the outer ones, counter-clockwise."""
    layout: Literal["corners", "cross"] = "corners"
    """Outer points at (+-step_x, +-step_y), or on the axes. The paper shows it only in a figure."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        lengths = ("step_x", "step_y", "depth_step", "depth_max", "angle_step", "shear")
        check_positive(self, (*lengths, "clearance"))
        steps = self.depth_max / self.depth_step
        if abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
            raise ValueError(
                f"depth_max: {self.depth_max!r}; allowed: a multiple of depth_step "
                f"({self.depth_step!r})"
            )
        turns = 2 * math.pi / self.angle_step
        if abs(turns - round(turns)) > 1e-6 or round(turns) < 1:
            raise ValueError(f"angle_step: {self.angle_step!r} rad; allowed: a part of 2 pi")
        if self.layout not in ("corners", "cross"):
            raise ValueError(f"layout: {self.layout!r}; allowed: 'corners', 'cross'")
        allowed = range(1, 6)
        if not self.points or any(point not in allowed for point in self.points):
            raise ValueError(f"points: {self.points!r}; allowed: numbers from 1 to 5")
        if len(set(self.points)) != len(self.points):
            raise ValueError(f"points: {self.points!r}; allowed: each number once")

    @property
    def kind(self) -> str:
        """`press_shear`."""
        return self.KIND

    @property
    def depth_count(self) -> int:
        """Number of depths."""
        return round(self.depth_max / self.depth_step)

    @property
    def direction_count(self) -> int:
        """Number of shear directions."""
        return round(2 * math.pi / self.angle_step)

    def __len__(self) -> int:
        """Return the number of targets."""
        return len(self.points) * self.depth_count * self.direction_count

    def position(self, point: int) -> tuple[float, float]:
        """Return the position of contact point `point` (1 to 5) [m]."""
        if point == 1:
            return (0.0, 0.0)
        signs = {
            "corners": ((1, 1), (-1, 1), (-1, -1), (1, -1)),
            "cross": ((1, 0), (0, 1), (-1, 0), (0, -1)),
        }[self.layout]
        sign_x, sign_y = signs[point - 2]
        return (sign_x * self.step_x, sign_y * self.step_y)

    def targets(self) -> Iterator[Target]:
        """Yield the targets point by point, from shallow to deep, direction by direction."""
        index = 0
        for point in self.points:
            x, y = self.position(point)
            origin: Point = (x, y, self.clearance)
            for level in range(1, self.depth_count + 1):
                depth = self.depth_max * level / self.depth_count
                for direction in range(self.direction_count):
                    angle = 2 * math.pi * direction / self.direction_count
                    yield Target(
                        index=index,
                        point=point,
                        depth=depth,
                        direction=direction,
                        origin=origin,
                        bottom=(x, y, -depth),
                        sheared=(
                            x + self.shear * math.cos(angle),
                            y + self.shear * math.sin(angle),
                            -depth,
                        ),
                    )
                    index += 1

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the four phases of one target."""
        corners = (target.origin, target.bottom, target.sheared, target.bottom, target.origin)
        return tuple(
            Move(target=target.index, phase=phase, start=corners[phase], end=corners[phase + 1])
            for phase in range(4)
        )
