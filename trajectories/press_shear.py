"""Algorithm 1 of the paper: press, shear, shear back, release, at every depth and direction.

For each of the contact points and each target (depth x direction) the tip goes
p0 -> p1 -> p2 -> p1 -> p0: straight down, sideways, back, straight up.

On a domed sensor the outer points lie lower than the centre, and so do their p0, p1 and p2: depths
are measured from the surface at the point. The sideways move keeps its height.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

from trajectories.moves import Move, Point, Target, check_positive, dome_height

Layout = Literal["corners", "cross"]
PointOrder = Literal["authors", "quadrants"]


# Signs of x and y of points 2 to 5 in the order `quadrants`, counter-clockwise.
_SIGNS: dict[str, tuple[tuple[int, int], ...]] = {
    "corners": ((1, 1), (-1, 1), (-1, -1), (1, -1)),
    "cross": ((1, 0), (0, 1), (-1, 0), (0, -1)),
}


@dataclass(frozen=True, slots=True)
class PressShear:
    """Press-shear targets on a five-point pattern.

    The counts are those of the paper: five points, four depths and twelve directions (30 deg) give
    240 targets, eight directions (45 deg) give 160, one point alone gives 48.

    Raises:
        ValueError: A length that is not positive, a depth that is not a whole number of steps, an
            angle that does not divide the circle, a point that is not in the pattern, or a dome
            that does not reach under all points.
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
    layout: Layout = "corners"
    """Outer points at (+-step_x, +-step_y), or on the axes. The paper shows it only in a figure."""
    order: PointOrder = "authors"
    """Where point 2 is: `authors`, as in the collector of the paper's authors, at (-x, +y);
    `quadrants` at (+x, +y). Points 3 to 5 follow counter-clockwise."""
    dome_radius: float | None = field(
        default=None, metadata={"unit": "mm", "plausible": (5, 5000), "stored": "unless default"}
    )
    """Radius of the sensor's spherical top, its apex at the origin [m]; None: flat."""

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
        for name, known in (("layout", get_args(Layout)), ("order", get_args(PointOrder))):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: {', '.join(known)}")
        allowed = range(1, 6)
        if not self.points or any(point not in allowed for point in self.points):
            raise ValueError(f"points: {self.points!r}; allowed: numbers from 1 to 5")
        if len(set(self.points)) != len(self.points):
            raise ValueError(f"points: {self.points!r}; allowed: each number once")
        farthest = max(math.hypot(*self.position(point)) for point in self.points) + self.shear
        if self.dome_radius is not None and not farthest < self.dome_radius < math.inf:
            raise ValueError(
                f"dome_radius: {self.dome_radius!r}; allowed: above {farthest:.6g}, the distance "
                "of the farthest place from the centre"
            )

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
        signs = _SIGNS[self.layout]
        if self.order == "authors":
            signs = (*signs[1:], signs[0])
        sign_x, sign_y = signs[point - 2]
        return (sign_x * self.step_x, sign_y * self.step_y)

    def height(self, x: float, y: float) -> float:
        """Return the height of the undeformed surface at a place [m]; 0 at the centre."""
        return dome_height(self.dome_radius, x, y)

    def direction_angle(self, direction: int) -> float:
        """Return the angle of a shear direction [rad], counter-clockwise from +x."""
        return 2 * math.pi * direction / self.direction_count

    def targets(self) -> Iterator[Target]:
        """Yield the targets point by point, from shallow to deep, direction by direction."""
        index = 0
        for point in self.points:
            x, y = self.position(point)
            surface = self.height(x, y)
            origin: Point = (x, y, surface + self.clearance)
            for level in range(1, self.depth_count + 1):
                depth = self.depth_max * level / self.depth_count
                for direction in range(self.direction_count):
                    angle = self.direction_angle(direction)
                    yield Target(
                        index=index,
                        point=point,
                        depth=depth,
                        direction=direction,
                        origin=origin,
                        bottom=(x, y, surface - depth),
                        sheared=(
                            x + self.shear * math.cos(angle),
                            y + self.shear * math.sin(angle),
                            surface - depth,
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
