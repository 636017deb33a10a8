"""The force-depth trajectory: repeated straight presses, for material compensation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from trajectories.moves import Move, Target, check_positive, down_and_up


@dataclass(frozen=True, slots=True)
class ForceDepth:
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

    @property
    def kind(self) -> str:
        """`force_depth`."""
        return self.KIND

    def __len__(self) -> int:
        """Return the number of targets."""
        return self.repeats

    def targets(self) -> Iterator[Target]:
        """Yield the same press `repeats` times."""
        origin = (0.0, 0.0, self.clearance)
        bottom = (0.0, 0.0, -self.depth_max)
        for index in range(self.repeats):
            yield Target(
                index=index,
                point=1,
                depth=self.depth_max,
                direction=-1,
                origin=origin,
                bottom=bottom,
                sheared=bottom,
            )

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the loading and the unloading move."""
        return down_and_up(target)
