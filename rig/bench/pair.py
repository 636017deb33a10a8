"""A hand of two fingers and the object that it grasps: settings of its simulation.

The hand's frame: x from the left skin to the right one along the grip axis, z along the fingers
towards their tips, y completes it.
"""

from dataclasses import dataclass, field

from rig.bench.worlds import WorldSpec

# Names of the fingers, in the order of every array of a hand.
FINGERS = ("left", "right")


@dataclass(frozen=True, slots=True)
class GraspObject:
    """Rigid object between two fingers, with the shape of an indenter on each side.

    Raises:
        ValueError: A value is out of range.
    """

    name: str
    faces: tuple[str, str] = ("cylinder", "cylinder")
    """Indenters whose tips touch the left and the right skin."""
    width: float = field(default=0.04, metadata={"unit": "mm", "plausible": (1, 140)})
    """Distance between the tips of both faces [m]."""
    mass: float = field(default=0.05, metadata={"unit": "kg", "plausible": (0.001, 5)})
    """Mass [kg]."""
    friction: float = 1.0
    """Friction of its faces over that of the skin's row."""

    def __post_init__(self) -> None:
        for name in ("width", "mass"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: above 0")
        if not self.friction >= 0:
            raise ValueError(f"friction: {self.friction!r}; allowed: 0 or more")


@dataclass(frozen=True, slots=True)
class PairSpec:
    """Two skins in one hand.

    Raises:
        ValueError: The compliance is negative.
    """

    left: WorldSpec
    right: WorldSpec
    compliance: float = 2e-5
    """Way by which each finger bends per grip force [m/N]; assumed, no hand was measured."""

    def __post_init__(self) -> None:
        if not self.compliance >= 0:
            raise ValueError(f"compliance: {self.compliance!r}; allowed: 0 or more")
