"""Dry run of a plan without hardware: workspace box, depth and duration of its moves."""

import math
from dataclasses import dataclass, field

from trajectories.plans import Plan, Point, dome_height


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a sensor and a bench, in the contact frame."""

    box_x: tuple[float, float] = field(metadata={"unit": "mm", "plausible": (0.1, 500)})
    """Allowed x of the tip [m]."""
    box_y: tuple[float, float] = field(metadata={"unit": "mm", "plausible": (0.1, 500)})
    """Allowed y [m]."""
    depth_max: float = field(metadata={"unit": "mm", "plausible": (0.02, 50)})
    """Deepest indentation [m]."""
    height_max: float = field(metadata={"unit": "mm", "plausible": (1, 1000)})
    """Highest z [m]."""
    duration_max: float = field(metadata={"unit": "min", "plausible": (0.1, 3000)})
    """Longest session [s]."""


@dataclass(frozen=True, slots=True)
class DryRun:
    """Result of a dry run of a plan."""

    targets: int
    """Number of targets."""
    moves: int
    """Number of recorded moves."""
    x: tuple[float, float]
    """Smallest and largest x [m]."""
    y: tuple[float, float]
    """Smallest and largest y [m]."""
    depths: tuple[float, ...]
    """Deepest indentation of each target [m]; on a dome, a shear towards the apex goes deeper."""
    duration: float
    """Moving time, recorded and between targets [s]; pauses are not included."""
    recorded: float
    """Recorded part of the duration [s]."""
    broken: tuple[str, ...]
    """Description of each limit that would be exceeded; empty if the plan may run."""

    @property
    def depth(self) -> float:
        """Deepest indentation of all [m]."""
        return max(self.depths)


def move_duration(length: float, speed: float, acceleration: float) -> float:
    """Return the duration of a move from rest to rest [s]; length [m], speed [m/s].

    Speed rises at `acceleration` [m/s^2], stays at `speed` and falls at `acceleration`; a move
    shorter than speed^2 / acceleration never reaches `speed`.
    """
    if length <= speed * speed / acceleration:
        return 2 * math.sqrt(length / acceleration)
    return length / speed + speed / acceleration


def dry_run(
    plan: Plan,
    limits: Limits,
    *,
    speed: float,
    acceleration: float,
    dome_radius: float | None = None,
) -> DryRun:
    """Dry-run `plan` and compare every point with `limits`.

    Speed [m/s] and acceleration [m/s^2] are those of the recorded moves.
    """
    points: list[Point] = []
    depths: list[float] = []
    recorded = unrecorded = 0.0
    moves = 0
    for target in plan.targets():
        path = plan.moves(target)
        if points:
            unrecorded += move_duration(math.dist(points[-1], path[0].start), speed, acceleration)
        for move in path:
            recorded += move_duration(math.dist(move.start, move.end), speed, acceleration)
        moves += len(path)
        ends = [place for move in path for place in (move.start, move.end)]
        points += ends
        depths.append(max(dome_height(dome_radius, x, y) - z for x, y, z in ends))
    low = tuple(min(point[axis] for point in points) for axis in range(3))
    high = tuple(max(point[axis] for point in points) for axis in range(3))
    depth = max(depths)
    duration = recorded + unrecorded
    broken = [
        f"{axis}: {1e3 * a:.2f} to {1e3 * b:.2f} mm; "
        f"allowed: {1e3 * box[0]:.2f} to {1e3 * box[1]:.2f} mm"
        for axis, a, b, box in zip("xy", low, high, (limits.box_x, limits.box_y), strict=False)
        if a < box[0] or b > box[1]
    ]
    if depth > limits.depth_max + 1e-9:
        broken.append(f"depth: {1e3 * depth:.3f} mm; allowed: {1e3 * limits.depth_max:.3f} mm")
    if high[2] > limits.height_max + 1e-9:
        broken.append(f"height: {1e3 * high[2]:.2f} mm; allowed: {1e3 * limits.height_max:.2f} mm")
    if duration > limits.duration_max:
        broken.append(f"duration: {duration:.0f} s; allowed: {limits.duration_max:.0f} s")
    return DryRun(
        targets=len(plan),
        moves=moves,
        x=(low[0], high[0]),
        y=(low[1], high[1]),
        depths=tuple(depths),
        duration=duration,
        recorded=recorded,
        broken=tuple(broken),
    )
