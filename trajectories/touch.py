"""Slow approaches until contact, for measuring the height of the surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from trajectories.moves import Move, Target, check_positive, dome_height, down_and_up


@dataclass(frozen=True, slots=True)
class Touch:
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

    @property
    def kind(self) -> str:
        """`touch`."""
        return self.KIND

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
            yield Target(
                index=index,
                point=point,
                depth=self.travel,
                direction=-1,
                origin=(x, y, surface + self.clearance),
                bottom=bottom,
                sheared=bottom,
            )

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the move down, and the move up in case there was no contact."""
        return down_and_up(target)
