"""Scene of a simulation: all of its inputs, as one frozen value."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import (
    SceneError,
    check_choice,
    check_kind,
    check_range,
    is_finite,
    make_plain,
    plain,
)
from sim.indenters import Indenter
from trajectories import Plan, Target

# Soft body: an elastomer layer bonded to a rigid base, square or round, flat or domed on top.

Places = NDArray[np.floating[Any]]

Footprint = Literal["rectangle", "ellipse"]
# Least height of a dome at its lowest point, over the thickness.
RIM_LEAST = 0.05


@dataclass(frozen=True, slots=True)
class Body:
    """Block or disc of soft material whose lower face is bonded to a rigid plate; sides are free.

    Contact frame: the origin is the centre of the undeformed top (a dome's apex), z points out of
    the material, so the material fills z from -thickness to 0. Compressible neo-Hookean:
    W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((J^2 - 1)/2 - ln J). Defaults are the paper's gel.

    Raises:
        SceneError: A value is outside of the allowed range of its field.
    """

    size_x: float = field(default=20e-3, metadata={"unit": "mm"})
    """Width along x [m], 1e-4 to 1."""
    size_y: float = field(default=20e-3, metadata={"unit": "mm"})
    """Width along y [m], 1e-4 to 1."""
    thickness: float = field(default=4e-3, metadata={"unit": "mm"})
    """Height from the base to the top (to the apex, with a dome) [m], 1e-4 to 1."""
    modulus: float = field(default=0.145e6, metadata={"unit": "kpa"})
    """Young's modulus at rest, after all relaxation [Pa], 1e2 to 1e9."""
    poisson: float = 0.45
    """Poisson's ratio at rest, 0 to 0.49995; 0.5 (incompressible) is not supported."""
    dome_radius: float | None = field(default=None, metadata={"unit": "mm"})
    """Radius of a spherical top [m]; None: flat. At its lowest point, a corner or an end of the
    ellipse, the body must still be 5 % of the thickness high."""
    density: float = 1070.0
    """Mass per volume [kg/m^3], 1 to 1e5; used only by inertia and gravity."""
    footprint: Footprint = field(default="rectangle", metadata={"stored": "unless default"})
    """Outline in plan: the rectangle `size_x` by `size_y`, or the `ellipse` inscribed in it, a
    circle if both are equal. Its side wall is vertical."""

    def __post_init__(self) -> None:
        make_plain(self)
        for name in ("size_x", "size_y", "thickness"):
            check_range("body", name, getattr(self, name), 1e-4, 1.0, unit="m")
        check_range("body", "modulus", self.modulus, 1e2, 1e9, unit="Pa")
        check_range("body", "poisson", self.poisson, 0.0, 0.49995)
        check_range("body", "density", self.density, 1.0, 1e5, unit="kg/m^3")
        check_choice("body.footprint", self.footprint, get_args(Footprint))
        if self.dome_radius is not None:
            check_range("body", "dome_radius", self.dome_radius, self._farthest, 1e3, unit="m")
            if self.rim < RIM_LEAST * self.thickness:
                raise SceneError(
                    f"body.dome_radius: {self.dome_radius!r} m; the lowest place of the rim would "
                    f"be {self.rim * 1e3:.3g} mm high; allowed: {100 * RIM_LEAST:g} % of the "
                    "thickness or more, by a larger radius or a smaller body"
                )

    @property
    def shear_modulus(self) -> float:
        """G = E / (2 (1 + nu)) [Pa]."""
        return self.modulus / (2 * (1 + self.poisson))

    @property
    def bulk_modulus(self) -> float:
        """K = E / (3 (1 - 2 nu)) [Pa]."""
        return self.modulus / (3 * (1 - 2 * self.poisson))

    @property
    def wave_modulus(self) -> float:
        """M = K + 4 G / 3 [Pa], of waves of compression, whose speed is sqrt(M / density)."""
        return self.bulk_modulus + 4 / 3 * self.shear_modulus

    @property
    def _farthest(self) -> float:
        """Distance of the footprint's farthest point from its centre [m]."""
        if self.footprint == "ellipse":
            return max(self.size_x, self.size_y) / 2
        return math.hypot(self.size_x, self.size_y) / 2

    @property
    def rim(self) -> float:
        """Height of the body at the lowest point of its rim [m]: the thickness if flat."""
        if self.dome_radius is None:
            return self.thickness
        drop = self.dome_radius - math.sqrt(self.dome_radius**2 - self._farthest**2)
        return self.thickness - drop

    def covers(self, x: Places, y: Places) -> NDArray[np.bool_]:
        """Return True for places on the footprint or its outline; `x` and `y` [m] broadcast."""
        half_x, half_y = self.size_x / 2, self.size_y / 2
        if self.footprint == "rectangle":
            return np.asarray((np.abs(x) <= half_x) & (np.abs(y) <= half_y))
        return np.asarray(np.hypot(x / half_x, y / half_y) <= 1.0)

    def from_side(self, x: Places, y: Places) -> Array:
        """Return distances from the nearest side [m], negative outside; `x`, `y` [m] broadcast.

        Exact in a rectangle and in a circle; in an ellipse it is a lower bound.
        """
        half_x, half_y = self.size_x / 2, self.size_y / 2
        if self.footprint == "rectangle":
            return np.asarray(np.minimum(half_x - np.abs(x), half_y - np.abs(y)))
        return np.asarray((1.0 - np.hypot(x / half_x, y / half_y)) * min(half_x, half_y))

    def fractions(self, x: Places, y: Places) -> Array:
        """Return the exact fraction of each cell that the footprint covers (X - 1, Y - 1).

        The edges of the cells are at x (X,) and y (Y,) [m], rising.
        """
        u, v = (
            np.clip(edges / (size / 2), -1.0, 1.0)
            for edges, size in ((x, self.size_x), (y, self.size_y))
        )
        area = np.outer(u, v) if self.footprint == "rectangle" else _disc_area(u[:, None], v)
        cell = np.diff(np.diff(area, axis=0), axis=1)
        whole = np.outer(np.diff(x), np.diff(y)) / (self.size_x * self.size_y / 4)
        return np.asarray(np.round(cell / whole, 9))  # so that whole cells have exactly 1

    def height(self, x: float, y: float) -> float:
        """Return the height of the undeformed top at (x, y) [m]: 0 if flat, below 0 off an apex."""
        return float(self.heights_at(np.asarray(x), np.asarray(y)))

    def heights(self, x: Places, y: Places) -> Array:
        """Return heights of the undeformed top on a grid of x (X,) and y (Y,): (X, Y) [m]."""
        return self.heights_at(np.asarray(x)[:, None], y)

    def heights_at(self, x: Places, y: Places) -> Array:
        """Return the height of the undeformed top at x and y, broadcast together [m].

        Beyond an ellipse it is the height of the rim in the direction of the centre.
        """
        if self.dome_radius is None:
            return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
        if self.footprint == "ellipse":
            beyond = np.square(x / (self.size_x / 2)) + np.square(y / (self.size_y / 2))
            away = (np.square(x) + np.square(y)) / np.maximum(beyond, 1.0)
            return np.asarray(np.sqrt(self.dome_radius**2 - away) - self.dome_radius)
        square = self.dome_radius**2 - np.square(x) - np.square(y)
        return np.asarray(np.sqrt(square) - self.dome_radius)


def _disc_area(u: Array, v: Array) -> Array:
    """Return the unit disc's area between 0 and u, 0 and v (|u|, |v| <= 1); odd in both."""
    side, across = np.abs(u), np.abs(v)
    corner = np.sqrt(1.0 - np.square(across))  # where the circle meets the line at v

    def below_circle(place: Array) -> Array:
        return np.asarray((place * np.sqrt(1.0 - np.square(place)) + np.arcsin(place)) / 2)

    cut = across * corner + below_circle(side) - below_circle(corner)
    return np.asarray(np.sign(u) * np.sign(v) * np.where(side <= corner, side * across, cut))


# Motion of the indenter's tip: straight lines between waypoints, with a result at each.

# Fastest tip [m/s], and longest rest [s].
SPEED_MAX, HOLD_MAX = 1e4, 1e9
# A position of the tip in the contact frame [m].
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Motion:
    """Waypoints of the tip in the contact frame; the result has a frame for each of them.

    The tip is the indenter's lowest point; z = 0 touches a flat body, negative z presses. Between
    waypoints the tip moves straight at constant speed. The solver may take smaller steps, never
    larger.

    Raises:
        SceneError: There is no waypoint, times do not begin at 0 or do not rise, or a number is not
            finite.
    """

    tip: tuple[Point, ...]
    """Position of the tip at each waypoint [m]."""
    time: tuple[float, ...]
    """Time of each waypoint [s]; starts at 0 and rises. Used only by viscosity and inertia."""
    depth_max: float = field(init=False, repr=False, compare=False)
    """Deepest indentation below z = 0 [m]; 0 if it never presses. It follows from the waypoints."""

    def __post_init__(self) -> None:
        make_plain(self)
        _check_sequence("motion.tip", self.tip, "positions (x, y, z) [m]")
        _check_sequence("motion.time", self.time, "numbers [s]")
        if not len(self.tip) or len(self.tip) != len(self.time):
            raise SceneError(
                f"motion: {len(self.tip)} positions and {len(self.time)} times; allowed: as many "
                "of both, at least one"
            )
        _check_points(self.tip)
        rising = all(map(is_finite, self.time)) and all(a < b for a, b in pairwise(self.time))
        if not rising or self.time[0] != 0:
            raise SceneError(
                f"motion.time: {self.time[:4]!r}...; allowed: 0 first, then rising [s]"
            )
        object.__setattr__(self, "depth_max", max(0.0, max(-point[2] for point in self.tip)))

    def __len__(self) -> int:
        """Return the number of waypoints, which is the number of frames in the result."""
        return len(self.tip)


def press(
    depths: Sequence[float],
    *,
    hold: float = 0.0,
    shear: float = 0.0,
    angle: float = 0.0,
    steps: int = 1,
    at: tuple[float, float] = (0.0, 0.0),
    speed: float = 10e-3,
) -> Motion:
    """Return the motion that touches the surface, then goes to each of `depths` [m] in turn.

    Args:
        depths: Depths below the touched surface [m], 0 or more.
        hold: Rest at the last depth [s]; 0: none.
        shear: Then a move sideways by this length [m], back and up to the surface; 0: none.
        angle: Direction of the shear, from x towards y [rad], at most a turn.
        steps: Equal parts of each move and of the hold, with a frame at the end of each.
        at: Position of the tip along x and y [m].
        speed: Speed of the tip [m/s].

    Raises:
        SceneError: `depths` is no sequence of numbers or repeats the tip's position, or another
            value is out of range.
    """
    depths, hold, shear, angle = plain(depths), plain(hold), plain(shear), plain(angle)
    steps, at = plain(steps), plain(at)
    _check_sequence("motion.depths", depths, "numbers [m], such as (0.5e-3, 1e-3)")
    before = 0.0
    for index, depth in enumerate(depths):
        if not is_finite(depth) or depth < 0 or depth == before:
            allowed = f"0 or more, and another than {before!r} m, where the tip already is"
            raise SceneError(f"motion.depths[{index}]: {depth!r} m; allowed: {allowed}")
        before = depth
    _check_sequence("motion.at", at, "2 finite numbers [m]")
    if len(at) != 2 or not all(map(is_finite, at)):
        raise SceneError(f"motion.at: {at!r}; allowed: 2 finite numbers [m]")
    _check_steps(steps)
    check_range("motion", "hold", hold, 0.0, HOLD_MAX, unit="s")
    check_range("motion", "shear", shear, -1.0, 1.0, unit="m")
    check_range("motion", "angle", angle, -math.tau, math.tau, unit="rad")
    corners = [(at[0], at[1], 0.0)] + [(at[0], at[1], -depth) for depth in depths]
    if shear:
        aside = (at[0] + shear * math.cos(angle), at[1] + shear * math.sin(angle), corners[-1][2])
        corners += [aside, corners[-1], corners[0]]
    points = corners if steps == 1 else _subdivided(corners, steps)
    moved = through(points, speed=speed)
    return _rested(moved, steps * len(depths), hold, steps) if hold else moved


def _rested(motion: Motion, index: int, hold: float, steps: int) -> Motion:
    """Return the motion with a rest of `hold` [s] in `steps` frames after waypoint `index`."""
    tip, time = motion.tip, motion.time
    rest = [time[index] + hold * step / steps for step in range(1, steps + 1)]
    return Motion(
        tip=(*tip[: index + 1], *[tip[index]] * steps, *tip[index + 1 :]),
        time=(*time[: index + 1], *rest, *(later + hold for later in time[index + 1 :])),
    )


def from_target(plan: Plan, target: Target, *, steps: int = 5, speed: float = 10e-3) -> Motion:
    """Return the motion of one target of a plan, with each of its moves in `steps` equal parts.

    The part above z = 0 belongs to the motion too, so contact is found, not assumed.
    """
    _check_steps(steps)
    moves = plan.moves(target)
    corners = [moves[0].start] + [move.end for move in moves]
    return through(_subdivided(corners, steps), speed=speed)


def through(points: Sequence[Point], *, speed: float) -> Motion:
    """Return the motion along `points` [m] at constant `speed` [m/s]."""
    points, speed = plain(points), plain(speed)
    check_range("motion", "speed", speed, 0.0, SPEED_MAX, unit="m/s", open_low=True)
    _check_sequence("motion.tip", points, "positions (x, y, z) [m]")
    if not points:
        raise SceneError("motion.tip: no positions; allowed: 1 or more")
    _check_points(points)
    lengths = np.linalg.norm(np.diff(np.asarray(points, float), axis=0), axis=1)
    if (lengths == 0).any():
        index = int(np.argmin(lengths)) + 1
        raise SceneError(
            f"motion.tip[{index}]: {points[index]!r}, where the tip already is; allowed: another "
            "place than the one before"
        )
    time = np.concatenate([[0.0], np.cumsum(lengths) / speed])
    return Motion(tip=tuple(points), time=tuple(time.tolist()))


def _check_steps(steps: int) -> None:
    if type(steps) is not int or steps < 1:
        raise SceneError(f"motion.steps: {steps!r}; allowed: whole numbers from 1 up")


def _check_sequence(name: str, value: Any, of: str) -> None:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise SceneError(f"{name}: {value!r}; allowed: a sequence of {of}")


def _check_points(points: Sequence[Point]) -> None:
    for index, point in enumerate(points):
        _check_sequence(f"motion.tip[{index}]", point, "3 finite numbers [m]")
        if len(point) != 3 or not all(map(is_finite, point)):
            raise SceneError(f"motion.tip[{index}]: {point!r}; allowed: 3 finite numbers [m]")


def _subdivided(corners: Sequence[Point], steps: int) -> list[Point]:
    points = [corners[0]]
    for start, end in pairwise(corners):
        for index in range(1, steps + 1):
            part = index / steps
            x, y, z = (a + (b - a) * part for a, b in zip(start, end, strict=True))
            points.append((x, y, z))
    return points


# Physical effects: Coulomb friction, viscosity, inertia and gravity. Those that are off are
# compiled out of the kernels.


@dataclass(frozen=True, slots=True)
class Friction:
    """Coulomb friction with one coefficient for stick and slip.

    Raises:
        SceneError: The coefficient is not within 0 to 10.
    """

    coefficient: float
    """Ratio of shear traction to pressure at which a point slips, 0 to 10."""

    def __post_init__(self) -> None:
        make_plain(self)
        check_range("friction", "coefficient", self.coefficient, 0.0, 10.0)


@dataclass(frozen=True, slots=True)
class Viscosity:
    """Maxwell branches parallel to a spring: E(t) = E (1 + sum_i ratio_i exp(-t / time_i)).

    E is `Body.modulus`, the modulus at rest. Form: Simo & Hughes, Computational Inelasticity
    (1998), section 10.3, on the second Piola-Kirchhoff stress.

    Raises:
        SceneError: There is no branch or more than 4, or a value is out of range.
    """

    ratios: tuple[float, ...]
    """Ratio of each branch's stiffness to the stiffness at rest, 0 to 100."""
    times: tuple[float, ...] = field(metadata={"unit": "s"})
    """Relaxation time of each branch [s], 1e-6 to 1e6."""
    relaxes: Literal["all", "shear"] = "all"
    """`all`: Poisson's ratio is constant in time (Lee & Radok's assumption); `shear`: the response
    to volume changes is elastic. Tier `layer` supports `all` only."""

    def __post_init__(self) -> None:
        make_plain(self)
        for name in ("ratios", "times"):
            check_kind(f"viscosity.{name}", getattr(self, name), tuple, "a sequence of numbers")
        if not 1 <= len(self.ratios) <= 4 or len(self.ratios) != len(self.times):
            raise SceneError(
                f"viscosity: {len(self.ratios)} ratios and {len(self.times)} times; allowed: the "
                "same number of both, 1 to 4"
            )
        for index, (ratio, time) in enumerate(zip(self.ratios, self.times, strict=True)):
            check_range("viscosity", f"ratios[{index}]", ratio, 0.0, 100.0)
            check_range("viscosity", f"times[{index}]", time, 1e-6, 1e6, unit="s")
        check_choice("viscosity.relaxes", self.relaxes, ("all", "shear"))


@dataclass(frozen=True, slots=True)
class Inertia:
    """Lumped mass: the body resists a change of its motion, and waves cross it.

    Raises:
        SceneError: A value is out of range.
    """

    scale: float = 1.0
    """Factor on `Body.density`, 0 to 1e6: 1 is the real mass, larger is mass scaling."""

    def __post_init__(self) -> None:
        make_plain(self)
        check_range("inertia", "scale", self.scale, 0.0, 1e6)


@dataclass(frozen=True, slots=True)
class Gravity:
    """Constant acceleration of the body's mass; the first frame is already in equilibrium with it.

    Raises:
        SceneError: A component is not within +-1000 m/s^2.
    """

    acceleration: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Acceleration in the contact frame [m/s^2]; +9.81 in z for a sensor that faces down."""

    def __post_init__(self) -> None:
        make_plain(self)
        if not isinstance(self.acceleration, tuple) or len(self.acceleration) != 3:
            raise SceneError(f"gravity.acceleration: {self.acceleration!r}; allowed: 3 numbers")
        for index, value in enumerate(self.acceleration):
            check_range("gravity", f"acceleration[{index}]", value, -1e3, 1e3, unit="m/s^2")


KINDS = {"friction": Friction, "viscosity": Viscosity, "inertia": Inertia, "gravity": Gravity}


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects beyond frictionless, quasi-static elasticity; None is off."""

    friction: Friction | None = None
    """Coulomb friction between indenter and skin."""
    viscosity: Viscosity | None = None
    """Relaxation of the material: force depends on speed, and is higher while loading."""
    inertia: Inertia | None = None
    """Mass: the body oscillates and waves propagate."""
    gravity: Gravity | None = None
    """Weight: the body sags."""

    def __post_init__(self) -> None:
        for name, kind in KINDS.items():
            allowed = f"{'an' if kind is Inertia else 'a'} {kind.__name__}"
            check_kind(f"effects.{name}", getattr(self, name), kind, allowed, optional=True)

    @property
    def key(self) -> tuple[str, ...]:
        """Names of the active effects in fixed order, used as key of the kernel cache."""
        return tuple(name for name in self.__slots__ if getattr(self, name) is not None)


@dataclass(frozen=True, slots=True)
class Scene:
    """Rigid indenter, soft body, motion, and the requested effects.

    Raises:
        SceneError: The tip goes deeper than 90 % of the thickness, or deeper than the known part of
            an indenter from a file.
    """

    indenter: Indenter
    motion: Motion
    body: Body = field(default_factory=Body)
    effects: Effects = field(default_factory=Effects)

    def __post_init__(self) -> None:
        check_kind("scene.indenter", self.indenter, Indenter, "an Indenter")
        check_kind("scene.motion", self.motion, Motion, "a Motion, such as press((1e-3,)) gives")
        check_kind("scene.body", self.body, Body, "a Body")
        check_kind("scene.effects", self.effects, Effects, "Effects")
        self._check_depth()
        solid = self.indenter.solid
        if solid is not None and self.motion.depth_max > solid.reach:
            raise SceneError(
                f"motion: {self.motion.depth_max * 1e3:.4g} mm deep with an indenter known up to "
                f"{solid.reach * 1e3:.4g} mm; allowed: as far as that (from_stl(reach=...) reads "
                "more of it)"
            )

    def _check_depth(self) -> None:
        """Reject a tip that leaves less than a tenth of the body's local height below it."""
        body, tip = self.body, self.motion.tip
        for x, y, z in tip if self.motion.depth_max > 0.9 * body.thickness else ():
            half_x, half_y = body.size_x / 2, body.size_y / 2
            top = body.height(min(max(x, -half_x), half_x), min(max(y, -half_y), half_y))
            limit = 0.9 * (body.thickness + top) - top
            if -z > limit:
                raise SceneError(
                    f"motion: {-z * 1e3:.4g} mm deep into a body {body.thickness * 1e3:.4g} mm "
                    f"thick; allowed: up to {limit * 1e3:.4g} mm (are the units metres?)"
                )


def beginning_of(scene: Scene, waypoints: int) -> Scene:
    """Return the scene with its first `waypoints` waypoints."""
    motion = scene.motion
    if waypoints == len(motion.tip):
        return scene
    return replace(scene, motion=Motion(motion.tip[:waypoints], motion.time[:waypoints]))
