"""Light taps at irregular intervals, for measuring the latency of a camera.

A regular rhythm would look the same one period later; these taps differ in height and depth, so
that no two intervals are equal.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from trajectories.moves import Move, Target, check_positive, down_and_up


@dataclass(frozen=True, slots=True)
class Taps:
    """`count` taps at the centre; the same seed gives the same taps.

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

    @property
    def kind(self) -> str:
        """`taps`."""
        return self.KIND

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
            yield Target(
                index=index,
                point=1,
                depth=depth,
                direction=-1,
                origin=(0.0, 0.0, heights[index]),
                bottom=bottom,
                sheared=bottom,
            )

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the move down, and the move up to the start of the next tap."""
        rise = (0.0, 0.0, self._drawn()[0][target.index + 1])
        return down_and_up(target, rise)
