"""The first press of a sensor with an indenter: in small steps, at the centre."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from trajectories.moves import Move, Target, check_positive, down_and_up

# Height of the press in the air and depth of the touch [m].
_AIR, _TOUCH = 1e-3, 0.05e-3
# Depths of the presses after them, as fractions of the planned one.
_STEPS = (0.1, 0.25, 0.5, 1.0)


@dataclass(frozen=True, slots=True)
class FirstPress:
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
    def kind(self) -> str:
        """`first_press`."""
        return self.KIND

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
            yield Target(
                index=index,
                point=1,
                depth=max(depth, 0.0),
                direction=-1,
                origin=origin,
                bottom=bottom,
                sheared=bottom,
            )

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the loading and the unloading move."""
        return down_and_up(target)
