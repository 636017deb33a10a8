"""Plans of the paper and of measurements: targets, moves and JSON form.

Frame: the contact frame. Its origin is on the undeformed surface of the sensor at its centre; z
points out of the sensor, so an indentation of a flat sensor is a negative z.

Algorithm 1 of the paper is `PressShear`. For each of the contact points and each target (depth x
direction) the tip goes p0 -> p1 -> p2 -> p1 -> p0: straight down, sideways, back, straight up. On a
domed sensor the outer points lie lower than the centre, and so do their p0, p1 and p2: depths are
measured from the surface at the point. The sideways move keeps its height. The other plans press
straight down and up again: for curves, surfaces, latency, and a sensor's first press.
"""

import dataclasses
import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, get_args

# Names of the phases; the index is the stored code.
PHASES = ("normal_inc", "shear_inc", "shear_dec", "normal_dec")

# A position of the indenter's tip in the contact frame [m].
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Target:
    """One press: position, depth and shear direction."""

    index: int
    """Index in the plan, from 0."""
    point: int
    """Number of the contact point, from 1 as in the paper."""
    depth: float
    """Indentation at the bottom [m], positive."""
    direction: int
    """Shear direction, 0 along +x and counter-clockwise; -1 for a press without shear."""
    origin: Point
    """p0, above the surface [m]."""
    bottom: Point
    """p1, straight below p0 at full depth [m]."""
    sheared: Point
    """p2, p1 moved sideways [m]; equal to p1 for a press without shear."""


@dataclass(frozen=True, slots=True)
class Move:
    """One straight, recorded move of a target."""

    target: int
    """Index of its target."""
    phase: int
    """Index into PHASES."""
    start: Point
    """Start point [m]."""
    end: Point
    """End point [m]."""


class Plan(Protocol):
    """Interface of a frozen spec, which yields its targets and the moves of each target."""

    KIND: ClassVar[str]
    """Name of the spec's type in bench files and sessions."""

    def __len__(self) -> int:
        """Return the number of targets."""

    def targets(self) -> Iterator[Target]:
        """Yield all targets in the order in which they are pressed."""

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the recorded moves of one target, each starting at the end of the previous one."""


def down_and_up(target: Target, end: Point | None = None) -> tuple[Move, ...]:
    """Return the moves of a press without shear: down, and up to `end`; by default to its p0."""
    up = target.origin if end is None else end
    return (
        Move(target.index, PHASES.index("normal_inc"), target.origin, target.bottom),
        Move(target.index, PHASES.index("normal_dec"), target.bottom, up),
    )


def dome_height(radius: float | None, x: float, y: float) -> float:
    """Return the height of a sensor's undeformed top at (x, y) [m], 0 at the centre.

    Its top is spherical, or flat without a radius, its apex at the origin of the contact frame;
    beyond the dome the height is that of its rim.
    """
    if radius is None:
        return 0.0
    return math.sqrt(max(radius * radius - x * x - y * y, 0.0)) - radius


def check_positive(spec: object, names: Sequence[str]) -> None:
    """Reject a spec with a field that is not a finite number above zero."""
    for name in names:
        value = getattr(spec, name)
        if not 0 < value < float("inf"):
            raise ValueError(f"{name}: {value!r}; allowed: a finite number above 0")


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
        for name, choices in (("layout", get_args(Layout)), ("order", get_args(PointOrder))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: {', '.join(choices)}")
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


def _press(
    index: int, depth: float, clearance: float, point: int = 1, surface: Point = (0.0, 0.0, 0.0)
) -> Target:
    x, y, top = surface
    bottom = (x, y, top - depth)
    return Target(index, point, max(depth, 0.0), -1, (x, y, top + clearance), bottom, bottom)


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
        check_positive(self, ("depth_max", "clearance"))
        if self.repeats < 1:
            raise ValueError(f"repeats: {self.repeats!r}; allowed: 1 or more")

    def __len__(self) -> int:
        return self.repeats

    def targets(self) -> Iterator[Target]:
        """Yield the same press `repeats` times."""
        for index in range(self.repeats):
            yield _press(index, self.depth_max, self.clearance)


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
        return len(self.depths)

    def targets(self) -> Iterator[Target]:
        """Yield the presses from the air to the full depth."""
        for index, depth in enumerate(self.depths):
            yield _press(index, depth, self.clearance)


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
        check_positive(self, ("travel", "clearance", "step_x", "step_y"))
        if self.repeats < 1:
            raise ValueError(f"repeats: {self.repeats!r}; allowed: 1 or more")
        if not self.points or any(point not in range(1, 6) for point in self.points):
            raise ValueError(f"points: {self.points!r}; allowed: numbers from 1 to 5")

    def __len__(self) -> int:
        return len(self.points) * self.repeats

    def position(self, point: int) -> tuple[float, float]:
        """Return the position of point `point` (1 to 5) [m]."""
        sign_x, sign_y = ((0, 0), *_SIGNS["corners"])[point - 1]
        return (sign_x * self.step_x, sign_y * self.step_y)

    def targets(self) -> Iterator[Target]:
        """Yield the targets point by point, each `repeats` times."""
        for index in range(len(self)):
            point = self.points[index // self.repeats]
            x, y = self.position(point)
            surface = (x, y, dome_height(self.dome_radius, x, y))
            yield _press(index, self.travel, self.clearance, point, surface)


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
        check_positive(self, ("depth_max", "height_min", "height_max"))
        if self.height_max <= self.height_min:
            raise ValueError(f"height_max: {self.height_max!r}; allowed: above height_min")
        if self.count < 1:
            raise ValueError(f"count: {self.count!r}; allowed: 1 or more")

    def __len__(self) -> int:
        return self.count

    def _drawn(self) -> tuple[list[float], list[float]]:
        rng = random.Random(self.seed)
        heights = [rng.uniform(self.height_min, self.height_max) for _ in range(self.count + 1)]
        return heights, [self.depth_max * rng.uniform(0.7, 1.0) for _ in range(self.count)]

    def targets(self) -> Iterator[Target]:
        """Yield one target per tap, each from its own height."""
        heights, depths = self._drawn()
        for index, depth in enumerate(depths):
            yield _press(index, depth, heights[index])

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the move down, and the move up to the start of the next tap."""
        rise = (0.0, 0.0, self._drawn()[0][target.index + 1])
        return down_and_up(target, rise)


# Conversion of plans to and from JSON, as stored in sessions.

# All specs, by kind.
KINDS: dict[str, type[Any]] = {
    spec.KIND: spec for spec in (PressShear, ForceDepth, Touch, Taps, FirstPress)
}


def plan_to_json(plan: Plan) -> dict[str, Any]:
    """Return the spec as plain JSON values in SI units, with its `kind`."""
    if not dataclasses.is_dataclass(plan) or isinstance(plan, type):
        raise TypeError(f"plan: {plan!r}; allowed: {sorted(KINDS)}")
    return {"kind": plan.KIND, **dataclasses.asdict(plan)}


def plan_from_json(stored: dict[str, Any]) -> Plan:
    """Return the spec that `plan_to_json` wrote.

    Raises:
        ValueError: An unknown kind, an unknown or missing field, or a value that the spec rejects.
    """
    fields = dict(stored)
    kind = fields.pop("kind", None)
    if kind not in KINDS:
        raise ValueError(f"plan.kind: {kind!r}; allowed: {sorted(KINDS)}")
    spec = KINDS[kind]
    field_names = {field.name for field in dataclasses.fields(spec)}
    if unknown := sorted(set(fields) - field_names):
        raise ValueError(f"plan: unknown {unknown}; known: {sorted(field_names)}")
    if missing := sorted(field_names - set(fields)):
        raise ValueError(f"plan: {', '.join(missing)} missing; a stored plan states every field")
    values = {
        name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()
    }
    plan: Plan = spec(**values)
    return plan
