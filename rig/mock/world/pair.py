"""PairWorld: a rigid object between the two skins of a hand, by superposed presses.

    world = PairWorld(PairSpec(WorldSpec("gelsight"), WorldSpec("uskin")))
    world.place(GraspObject("can", width=0.04, mass=0.2))
    state = world.step(t_ns, opening=0.0385, down=(0, 0, 1), lifted=True)

Along the grip axis the forces balance at every step. Across it the object is a mass on the springs
and sliders of both presses (`sim.ladder`), stepped by implicit Euler, which creates no energy. It
keeps its orientation. Frames are those of `rig.bench.pair`; a finger's own has z out of its skin
and y towards the finger's tip.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from rig.bench.pair import GraspObject, PairSpec
from rig.bench.worlds import WorldSpec
from rig.core.clock import SECOND_NS
from rig.mock.world.sensors import ladder_of, ladder_press
from rig.mock.world.views import Reading, reading_of

if TYPE_CHECKING:
    from rig.mock.world.sensors import Ahead, Ladder, LadderPress

GRAVITY = 9.80665
# From the hand's y and z to x and y of each finger.
_SIDES = np.array([[1.0, 1.0], [-1.0, 1.0]])
# Way across the grip at which an object has left the skins [m].
_LOST = 6e-3
# Error of the balance along the grip, and across it [N]; longest way of a step of its search [m].
_BALANCED, _HUNG, _STRIDE = 1e-5, 1e-7, 2e-4
# Way over which the slope of a normal force is taken [m], and its least value [N/m].
_SLOPE, _SOFT = np.array([0.0, 1e-6]), 1.0
# Most steps of a search.
_STEPS = 80


@dataclass(frozen=True, slots=True, eq=False)
class PairState:
    """State of a hand; arrays have the left finger first, each in its own contact frame."""

    t_ns: int
    wrench: np.ndarray
    """Wrench on each finger about the middle of its undeformed skin (2, 6) [N, N m]."""
    depth: np.ndarray
    """Depth of the object in each skin, negative apart from it (2,) [m]."""
    tip: np.ndarray
    """Tip of each face (2, 3) [m]."""
    shear: np.ndarray
    """Mean displacement of each contact sideways (2, 2) [m]."""
    slip: np.ndarray
    """Way that each whole face has slid over its skin while lifted (2,) [m]."""
    fallen: np.ndarray
    """Way of the object across the grip, along the hand's y and z, since it was placed (2,) [m]."""
    dropped: bool
    """True if the object has left the hand."""


def _ready_ladder(spec: WorldSpec, face: str) -> "Ladder":
    """Return the presses of a face on a skin, with the stiffness that takes a while to find."""
    ladder = ladder_of(spec, face)
    ladder.sideways  # noqa: B018
    return ladder


class PairWorld:
    """Two skins, and one object at a time between them.

    Raises:
        ConfigError: A sensor is unknown, or later a face; or the simulator is not installed.
    """

    def __init__(self, spec: PairSpec) -> None:
        self._specs = (spec.left, spec.right)
        self._compliance = spec.compliance
        self._object: GraspObject | None = None
        self._presses: tuple[LadderPress, ...] = ()
        self._ladder = cache(_ready_ladder)
        self._readings: dict[int, Reading] = {}
        self._t_ns: int | None = None
        self._clear()

    def _clear(self) -> None:
        self._depth, self._slip = np.full(2, -math.inf), np.zeros(2)
        self._way, self._speed = np.zeros(2), np.zeros(2)
        self._dropped = False

    def place(self, obj: GraspObject | None) -> None:
        """Put an object on the table between the open fingers, instead of any other; None: none."""
        self._clear()
        self._object, self._presses = obj, ()
        if obj is not None:
            self._presses = tuple(
                ladder_press(spec, face, obj.friction, self._ladder(spec, face))
                for spec, face in zip(self._specs, obj.faces, strict=True)
            )

    def step(
        self, t_ns: int, opening: float, down: Sequence[float] | np.ndarray, lifted: bool
    ) -> PairState:
        """Return the state at `t_ns`, which must not decrease.

        Args:
            t_ns: Time [ns].
            opening: Distance between the undeformed skins of unbent fingers [m].
            down: Unit vector of gravity in the hand's frame (3,).
            lifted: False: a table carries the object, on which it slides along the grip axis.
        """
        seconds = 0.0 if self._t_ns is None else (t_ns - self._t_ns) / SECOND_NS
        self._t_ns = t_ns
        if self._object is None or self._dropped:
            return self._state()
        mass = self._object.mass
        weight = mass * GRAVITY * np.asarray(down, float) * lifted
        ahead = [press.ahead(seconds) for press in self._presses]
        overlap = (self._object.width - opening) / 2
        normal = self._balance(ahead, overlap, float(weight[0]))
        way = np.zeros(2)
        if lifted and seconds:
            limits = [each * one.friction for each, one in zip(normal, ahead, strict=True)]
            way = self._hang(ahead, np.concatenate(limits), mass, weight[1:], seconds)
        self._speed = way / (seconds or 1.0)
        self._way = self._way + way
        for side, press in enumerate(self._presses):
            tip = np.array([*(_SIDES[side] * self._way), -self._depth[side]])
            slid = press.slide(tip, seconds)
            if lifted and normal[side].any():
                self._slip[side] += slid
        lost = not any(one.any() for one in normal) or math.hypot(*self._way) > _LOST
        self._dropped = bool(lifted and lost)
        return self._state()

    def _balance(self, ahead: "list[Ahead]", overlap: float, load: float) -> list[np.ndarray]:
        """Find the depths whose normal forces bear a load along x [N]; return those of springs.

        `overlap` is half of the object's width over the opening [m].
        """
        depth = np.where(np.isfinite(self._depth), self._depth, overlap)
        if overlap <= 0 and not load:
            depth = np.full(2, overlap)
        for _ in range(_STEPS):
            pairs = [one.normal(at + _SLOPE) for one, at in zip(ahead, depth, strict=True)]
            (first, near), (second, far) = ([float(v) for v in p.sum(axis=1)] for p in pairs)
            stiff = max((near - first) / _SLOPE[1], _SOFT), max((far - second) / _SLOPE[1], _SOFT)
            gap = depth[0] + depth[1] + self._compliance * (first + second) - 2 * overlap
            pull = second - first - load
            if abs(pull) < _BALANCED and abs(gap) * max(stiff) < _BALANCED:
                break
            a, b = (1 + self._compliance * one for one in stiff)
            # By the inverse of [[a, b], [-stiff[0], stiff[1]]].
            change = np.array([stiff[1] * gap - b * pull, stiff[0] * gap + a * pull])
            change /= a * stiff[1] + b * stiff[0]
            depth = depth - change * min(1.0, _STRIDE / max(float(np.abs(change).max()), _STRIDE))
        self._depth = depth
        return [pair[0] for pair in pairs]

    def _hang(
        self,
        ahead: "list[Ahead]",
        limit: np.ndarray,
        mass: float,
        weight: np.ndarray,
        seconds: float,
    ) -> np.ndarray:
        """Return the way (2,) [m] that the object takes across the grip in a step.

        Newton's method on the step of implicit Euler, with the springs' forces at its end; `limit`
        are those at which their sliders move [N].
        """
        start = np.concatenate([one.side * to for one, to in zip(ahead, _SIDES, strict=True)])
        stiff = np.concatenate([one.stiffness for one in ahead])
        inertia = mass / seconds**2
        coast, way, size = self._speed * seconds, np.zeros(2), math.inf
        last = rest = way
        for _ in range(_STEPS):
            trial = start + stiff * way
            length = np.maximum(np.hypot(trial[:, 0], trial[:, 1]), 1e-30)
            scale = np.minimum(limit / length, 1.0)[:, None]
            miss = inertia * (way - coast) - weight + (scale * trial).sum(axis=0)
            now = math.hypot(*miss)
            if now >= size:
                # As if nothing slid: a shorter step, which always leads nearer.
                way = last - rest / (inertia + stiff.sum(axis=0))
                continue
            size, last, rest = now, way, miss
            if size < _HUNG:
                break
            # Tangent: a spring whose slider moves resists only across its own force.
            along, resists = trial / length[:, None] * (scale < 1), scale * stiff
            (a, b), (c, d) = np.diag(inertia + resists.sum(axis=0)) - along.T @ (along * resists)
            newton = np.array([d * miss[0] - b * miss[1], a * miss[1] - c * miss[0]])
            way = way - newton / (a * d - b * c)
        return last

    def _state(self) -> PairState:
        wrench, tips, shear = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, 2))
        tips[:, 2] = math.inf
        for side, press in enumerate(self._touching()):
            tips[side], wrench[side], shear[side] = press.tip, press.wrench, press.shear
            (x, y, z), (fx, fy, fz) = press.tip, wrench[side, :3]
            if fz:
                wrench[side, 3:] += (y * fz - z * fy, z * fx - x * fz, x * fy - y * fx)
        t_ns, depth, slip, way = self._t_ns or 0, -tips[:, 2], self._slip.copy(), self._way.copy()
        return PairState(t_ns, wrench, depth, tips, shear, slip, way, self._dropped)

    def _touching(self) -> "tuple[LadderPress, ...]":
        return () if self._dropped else self._presses

    def reading(self, side: int) -> np.ndarray:
        """Return picture or raw counts of the last state, of the left finger (0) or the right."""
        if side not in self._readings:
            self._readings[side] = reading_of(self._specs[side])
        points, read = self._readings[side]
        presses = self._touching()
        moved = presses[side].markers(points) if presses else np.zeros((len(points), 3))
        return read(moved, self._t_ns or 0)
