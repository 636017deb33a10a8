"""The plan of a hand with two fingers: squeeze objects in steps, at several turns of the hand."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SqueezeStep:
    """One step: close, settle, hold."""

    point: int
    """Number of the object at its turn; each has its own reference."""
    object: int
    """Number of the object."""
    turn: Vector
    """Unit vector of gravity in the frame of the hand."""
    step: int
    """Number of the step; 0: open and empty, for the reference."""
    closing: float
    """Object's width less the opening [m]."""
    lifted: bool
    """True if only the fingers carry the object."""


@dataclass(frozen=True, slots=True)
class Squeeze:
    """Each object at each turn: close in steps, hold at each, release.

    Raises:
        ValueError: A value is out of range.
    """

    KIND: ClassVar[str] = "squeeze"

    turns: tuple[Vector, ...] = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    """Unit vectors of gravity in the frame of the hand: x from the left skin to the right one, z
    along the fingers to their tips."""
    steps: int = 5
    """Steps of a squeeze."""
    step: float = field(default=0.37e-3, metadata={"unit": "mm", "plausible": (0.01, 5)})
    """Closing of each step [m]."""
    lift: int = 2
    """Step from which only the fingers carry the object; 0: never."""
    clearance: float = field(default=4e-3, metadata={"unit": "mm", "plausible": (0.5, 40)})
    """Opening over the object's width before and after a squeeze [m]."""
    settle: float = field(default=1.5, metadata={"unit": "ms", "plausible": (100, 60000)})
    """Time after each motion in which the skins relax [s]."""
    hold: float = field(default=0.5, metadata={"unit": "ms", "plausible": (100, 60000)})
    """Time of each sample [s]."""

    def __post_init__(self) -> None:
        for turn in self.turns:
            if abs(sum(part**2 for part in turn) - 1) > 1e-3:
                raise ValueError(f"turns: found {list(turn)}; allowed: unit vectors")
        for name in ("step", "clearance", "settle", "hold"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: above 0")
        if self.steps < 1 or not 0 <= self.lift <= self.steps or not self.turns:
            raise ValueError("steps, lift, turns: allowed: 1 or more, 0 to steps, one or more")

    @property
    def deepest(self) -> float:
        """Largest closing [m]."""
        return self.steps * self.step

    def targets(self, objects: int) -> Iterator[SqueezeStep]:
        """Yield the steps for a number of objects, object by object and turn by turn."""
        for point in range(objects * len(self.turns)):
            number, turn = divmod(point, len(self.turns))
            for step in range(self.steps + 1):
                closing = step * self.step if step else -self.clearance
                lifted = 0 < self.lift <= step
                yield SqueezeStep(point, number, self.turns[turn], step, closing, lifted)
