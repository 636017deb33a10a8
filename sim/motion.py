"""Where the indenter's tip goes, and when: straight lines between waypoints, a result at each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sim.errors import SceneError
from trajectories import Plan, Point, Target


@dataclass(frozen=True, slots=True)
class Motion:
    """Waypoints of the tip in the contact frame; the solver reports a frame at each of them.

    The tip is the indenter's lowest point; z = 0 touches a flat body, negative z presses. Between
    waypoints the tip moves straight and evenly. The solver may take smaller steps, never larger.

    Raises:
        SceneError: No waypoint, times that do not begin at 0 or do not rise, or a number that is
            not finite.
    """

    tip: tuple[Point, ...]
    """Position of the tip at each waypoint [m]."""
    time: tuple[float, ...]
    """When it is there [s]; starts at 0 and rises. Only viscosity and inertia feel it."""

    def __post_init__(self) -> None:
        if not self.tip or len(self.tip) != len(self.time):
            raise SceneError(
                f"motion: {len(self.tip)} positions and {len(self.time)} times; allowed: as many "
                "of both, at least one"
            )
        _check_points(self.tip)
        rising = all(a < b for a, b in pairwise(self.time))
        if self.time[0] != 0 or not rising or not math.isfinite(self.time[-1]):
            raise SceneError(
                f"motion.time: {self.time[:4]!r}...; allowed: 0 first, then rising [s]"
            )

    def __len__(self) -> int:
        """Number of waypoints, and so of frames in the result."""
        return len(self.tip)

    @property
    def depth_max(self) -> float:
        """Deepest indentation below z = 0 [m]; 0 when it never presses."""
        return max(0.0, max(-point[2] for point in self.tip))


def press(
    depths: Sequence[float], *, at: tuple[float, float] = (0.0, 0.0), speed: float = 10e-3
) -> Motion:
    """Touch the surface, then go to each of `depths` [m] in turn at `speed` [m/s]."""
    return through(
        [(at[0], at[1], 0.0)] + [(at[0], at[1], -depth) for depth in depths], speed=speed
    )


def press_shear_return(
    depth: float,
    shear: float,
    *,
    angle: float = 0.0,
    steps: int = 5,
    at: tuple[float, float] = (0.0, 0.0),
    speed: float = 10e-3,
) -> Motion:
    """Algorithm 1's four phases: down by `depth`, sideways by `shear` at `angle` [rad], back, up.

    Each phase is cut into `steps` equal parts: 4 `steps` + 1 frames.
    """
    if not math.isfinite(angle):
        raise SceneError(f"motion.tip: sheared at an angle of {angle!r} rad; allowed: finite")
    low = (at[0], at[1], -depth)
    aside = (at[0] + shear * math.cos(angle), at[1] + shear * math.sin(angle), -depth)
    corners = [(at[0], at[1], 0.0), low, aside, low, (at[0], at[1], 0.0)]
    return through(_subdivided(corners, steps), speed=speed)


def ramp_hold(
    depth: float,
    *,
    ramp: float,
    hold: float,
    steps: int = 10,
    at: tuple[float, float] = (0.0, 0.0),
) -> Motion:
    """Down to `depth` [m] in `ramp` seconds, then still for `hold` seconds, `steps` frames each."""
    share = [index / steps for index in range(1, steps + 1)]
    tip = [(at[0], at[1], 0.0)]
    tip += [(at[0], at[1], -depth * part) for part in share]
    tip += [(at[0], at[1], -depth)] * steps
    time = [0.0] + [ramp * part for part in share] + [ramp + hold * part for part in share]
    return Motion(tip=tuple(tip), time=tuple(time))


def from_target(plan: Plan, target: Target, *, steps: int = 5, speed: float = 10e-3) -> Motion:
    """One target of a plan, each of its moves cut into `steps` equal parts.

    The stretch above z = 0 belongs to the motion too: contact is found, not assumed.
    """
    moves = plan.moves(target)
    corners = [moves[0].start] + [move.end for move in moves]
    return through(_subdivided(corners, steps), speed=speed)


def through(points: Sequence[Point], *, speed: float) -> Motion:
    """The motion along `points` [m] at constant `speed` [m/s].

    Raises:
        SceneError: A speed that is not above 0, or two equal points in a row (they take no time).
    """
    if not (math.isfinite(speed) and speed > 0):
        raise SceneError(f"motion.speed: {speed!r} m/s; allowed: above 0")
    _check_points(points)
    lengths = np.linalg.norm(np.diff(np.asarray(points, float), axis=0), axis=1)
    time = np.concatenate([[0.0], np.cumsum(lengths) / speed])
    return Motion(tip=tuple(points), time=tuple(float(value) for value in time))


def _check_points(points: Sequence[Point]) -> None:
    for index, point in enumerate(points):
        if len(point) != 3 or not all(math.isfinite(value) for value in point):
            raise SceneError(f"motion.tip[{index}]: {point!r}; allowed: 3 finite numbers [m]")


def _subdivided(corners: Sequence[Point], steps: int) -> list[Point]:
    points = [corners[0]]
    for start, end in pairwise(corners):
        for index in range(1, steps + 1):
            part = index / steps
            x, y, z = (a + (b - a) * part for a, b in zip(start, end, strict=True))
            points.append((x, y, z))
    return points
