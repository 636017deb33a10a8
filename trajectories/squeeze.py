"""The plan of a hand with two fingers: squeeze objects in steps, at several turns of the hand."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

from trajectories.plans import check_positive

Vector = tuple[float, float, float]


class SqueezeStep(NamedTuple):
    """One step: close, settle, hold.

    Step 0 is open and empty, for the reference of a `point`, the number of an object at a turn.
    `turn` is gravity's unit vector in the frame of the hand; `closing` is the object's width less
    the opening [m]; `lifted` is True if only the fingers carry the object.
    """

    point: int
    object: int
    turn: Vector
    step: int
    closing: float
    lifted: bool


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
    lift: int = 3
    """Step from which only the fingers carry the object; 0: never."""
    clearance: float = field(default=4e-3, metadata={"unit": "mm", "plausible": (0.5, 40)})
    """Opening over the object's width before and after a squeeze [m]."""
    settle: float = field(default=1.5, metadata={"unit": "ms", "plausible": (100, 60000)})
    """Time after each motion in which the skins relax [s]."""
    hold: float = field(default=0.5, metadata={"unit": "ms", "plausible": (100, 60000)})
    """Time of each sample [s]."""

    def __post_init__(self) -> None:
        check_positive(self, ("step", "clearance", "settle", "hold"))
        for turn in self.turns:
            if abs(sum(part**2 for part in turn) - 1) > 1e-3:
                raise ValueError(f"turns: found {list(turn)}; allowed: unit vectors")
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
