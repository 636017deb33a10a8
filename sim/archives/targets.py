"""The real trajectories: press, shear, shear back, release; and the force-depth presses.

A target is one press of `4 steps + 1` frames: p0, clear of the surface, then `steps` frames of each
phase. The force-depth presses come last: one path that goes down and up again `repeats` times, each
repeat a target beyond the others, as long as they are, without a location.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from itertools import pairwise

from sim.archives.plan import Plan, code
from sim.archives.press import NO_LOCATION, Press, Recording
from sim.errors import SceneError
from sim.motion import Motion, from_target, through
from sim.sensors import SimulatedSensor
from trajectories import PHASES, ForceDepth, Point, PressShear, Target

FORCE_DEPTH_INDENTER = "prism"
"""The paper's force-depth presses are made with it."""


def target_presses(plan: Plan, each: SimulatedSensor) -> tuple[Press, ...]:
    """All presses of a sensor: the chosen targets indenter by indenter, then force and depth.

    Raises:
        SceneError: A sensor without a trajectory.
    """
    if each.trajectory is None:
        raise SceneError(f"{each.name}.trajectory: None; allowed: a sensor that has one")
    targets = chosen_targets(each.trajectory, plan.share)
    presses = [
        _press(plan, each, each.trajectory, indenter, target)
        for indenter in plan.indenters
        for target in targets
    ]
    if each.force_depth is not None:
        presses.append(_force_depth(plan, each, each.trajectory, each.force_depth))
    return tuple(presses)


def chosen_targets(trajectory: PressShear, share: float) -> tuple[Target, ...]:
    """A share of the targets, one at least: evenly over points, depths and directions.

    One after the other, always one whose point, depth, direction and pairs of them came least
    often so far, so that a smaller share is a part of a larger one.
    """
    targets = list(trajectory.targets())
    count = max(1, round(share * len(targets)))
    if count == len(targets):
        return tuple(targets)
    met: dict[tuple[object, ...], int] = {}
    chosen: list[Target] = []
    rest = targets
    while len(chosen) < count:
        best = min(rest, key=lambda one: (*_often(met, _traits(one)), one.index))
        chosen.append(best)
        rest = [one for one in rest if one is not best]
        for trait in _traits(best):
            met[trait] = met.get(trait, 0) + 1
    return tuple(sorted(chosen, key=lambda one: one.index))


def session_points(trajectory: PressShear) -> int:
    """Contact points at which all indenters have pressed by the end of a sensor's session."""
    from sim.indenters import NAMES

    return len(NAMES) * len(trajectory.points)


def _traits(target: Target) -> tuple[tuple[object, ...], ...]:
    point, depth, direction = target.point, target.depth, target.direction
    singles = (("point", point), ("depth", depth), ("direction", direction))
    return (*singles, *((*a, *b) for a, b in pairwise((*singles, singles[0]))))


def _often(
    met: dict[tuple[object, ...], int], traits: Sequence[tuple[object, ...]]
) -> tuple[int, int]:
    """How often single traits came, and pairs of them."""
    often = [met.get(trait, 0) for trait in traits]
    return sum(often[:3]), sum(often[3:])


def _press(
    plan: Plan, each: SimulatedSensor, trajectory: PressShear, indenter: str, target: Target
) -> Press:
    count = 4 * plan.steps + 1
    phases = (0, *(phase for phase in range(len(PHASES)) for _ in range(plan.steps)))
    location = code(indenter) * len(trajectory) + target.index
    recording = Recording(
        target=target.index,
        number=_number(each, trajectory, indenter, target.index),
        session_point=_session_point(trajectory, indenter, target.point),
        frames=tuple(range(count)),
        phases=phases,
        locations=(location,) * count,
    )
    motion = _motion(trajectory, target, plan.steps, each.speed)
    return Press(indenter, motion, (recording,))


@functools.lru_cache(maxsize=4096)
def _motion(trajectory: PressShear, target: Target, steps: int, speed: float) -> Motion:
    """All indenters and most sensors of a group walk the same way."""
    return from_target(trajectory, target, steps=steps, speed=speed)


def _force_depth(
    plan: Plan, each: SimulatedSensor, trajectory: PressShear, spec: ForceDepth
) -> Press:
    """Loading and unloading in `2 steps` frames each, again and again without a pause."""
    half = 2 * plan.steps
    places: list[Point] = [next(spec.targets()).origin]
    recordings = []
    for target in spec.targets():
        first = len(places) - 1
        for move in spec.moves(target):
            places += _along(move.start, move.end, half)
        recordings.append(
            Recording(
                target=len(trajectory) + target.index,
                number=_number(
                    each, trajectory, FORCE_DEPTH_INDENTER, len(trajectory) + target.index
                ),
                session_point=_session_point(trajectory, FORCE_DEPTH_INDENTER, target.point),
                frames=tuple(range(first, first + 2 * half + 1)),
                phases=(
                    *(PHASES.index("normal_inc"),) * (half + 1),
                    *(PHASES.index("normal_dec"),) * half,
                ),
                locations=(NO_LOCATION,) * (2 * half + 1),
            )
        )
    return Press(FORCE_DEPTH_INDENTER, through(places, speed=each.speed), tuple(recordings))


def _along(start: Point, end: Point, steps: int) -> list[Point]:
    """Points behind `start`, `steps` of them, evenly up to `end`."""
    points: list[Point] = []
    for index in range(1, steps + 1):
        x, y, z = (a + (b - a) * index / steps for a, b in zip(start, end, strict=True))
        points.append((x, y, z))
    return points


def _number(each: SimulatedSensor, trajectory: PressShear, indenter: str, target: int) -> int:
    repeats = 0 if each.force_depth is None else each.force_depth.repeats
    return code(indenter) * (len(trajectory) + repeats) + target


def _session_point(trajectory: PressShear, indenter: str, point: int) -> int:
    """Indenter by indenter and point by point, as a lab would; force and depth with the prism's."""
    points = trajectory.points
    place = points.index(point) if point in points else 0
    return code(indenter) * len(points) + place
