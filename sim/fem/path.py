"""One press's way along its motion: which step comes next, and what a failed one costs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim.fem.numerics import Numerics
from sim.indenters import Indenter
from sim.scene import Scene

Array = NDArray[np.float64]

REST = 1e9
"""Time [s] after which any material has relaxed: how long a body stood before a motion begins."""
GROWTH = 1.5
"""How much longer a step may be than the last one that was accepted."""
RELAXATION_STEPS = 4
"""Steps within the shortest relaxation time, but at most `STEPS_MAX` in a segment."""
STEPS_MAX = 16


@dataclass(slots=True)
class Path:
    """Where one press stands on its motion; lengths in thicknesses.

    Segment 0 leads from above the body straight to the first waypoint, in no time: a motion that
    begins inside the body arrived there at once. Segment k leads to waypoint k.
    """

    corners: Array
    """Start and waypoints (F + 1, 3)."""
    times: Array
    """Time of each of them [s] (F + 1,); the first is before the body was touched."""
    longest: float
    """Longest step."""
    shortest_time: float
    """Shortest time that a step has to resolve [s]; inf when nothing depends on time."""
    halvings_max: int
    segment: int = 0
    share: float = 0.0
    """Share of the segment that is done."""
    step: float = 1.0
    """Share of the segment that the next step may take."""
    halvings: int = 0
    tried: list[str] = field(default_factory=list)

    @property
    def finished(self) -> bool:
        """Whether the last waypoint was reached."""
        return self.segment == len(self.corners) - 1

    @property
    def length(self) -> float:
        """Length of the present segment."""
        return float(np.linalg.norm(self.corners[self.segment + 1] - self.corners[self.segment]))

    @property
    def limit(self) -> float:
        """Largest share of the segment that one step may take."""
        duration = self.times[self.segment + 1] - self.times[self.segment]
        by_time = min(STEPS_MAX, max(1.0, duration / self.shortest_time * RELAXATION_STEPS))
        if not self.segment:
            by_time = 1.0
        steps = max(1.0, np.ceil(self.length / self.longest), np.ceil(by_time))
        return float(1.0 / steps)

    def goal(self) -> tuple[float, Array, float]:
        """Share of the segment after the next step, the tip there (3,), and the step's time [s]."""
        step = min(self.step, self.limit)
        left = 1.0 - self.share
        step = left if left < 1.2 * step else min(step, left)
        share = 1.0 if step == left else self.share + step
        start, end = self.corners[self.segment], self.corners[self.segment + 1]
        duration = (self.times[self.segment + 1] - self.times[self.segment]) * step
        if self.segment == 0:
            duration = REST if self.length == 0 else 0.0
        return share, start + (end - start) * share, float(duration)

    def accept(self, share: float) -> bool:
        """Take the step; whether a waypoint was reached."""
        step = share - self.share
        if share < 1.0:
            self.share = share
            self.step = step * GROWTH
            return False
        travel = step * self.length
        self.segment += 1
        self.share, self.halvings = 0.0, 0
        self.tried.clear()
        self.step = 1.0
        if not self.finished and self.length > 0 and travel > 0:
            self.step = max(travel, 0.25 * self.longest) * GROWTH / self.length
        return True

    def refuse(self, share: float, said: str) -> bool:
        """Give the step up and halve it; whether there is a smaller one to try."""
        step = share - self.share
        self.tried.append(f"segment {self.segment}, step of {step:.3g} of it: {said}")
        self.step = step / 2
        self.halvings += 1
        return self.halvings <= self.halvings_max and self.length > 0


def sharpest(indenter: Indenter) -> float:
    """Smallest radius that an indenter's surface may be rounded with [m]; 0 with a sharp edge."""
    if indenter.solid is not None:
        return indenter.edge_radius
    radii = [part.values[2] for part in indenter.parts if part.figure == "circle"]
    if any(part.join != "union" or part.figure == "path" for part in indenter.parts):
        radii.append(indenter.edge_radius)
    return min(radii, default=np.inf)


def path_of(scene: Scene, numerics: Numerics) -> Path:
    """The way of a scene's tip, in units of the body's thickness."""
    unit = scene.body.thickness
    tip = np.asarray(scene.motion.tip) / unit
    start = tip[0].copy()
    start[2] = max(start[2], 0.0)
    longest = max(sharpest(scene.indenter) / 2, unit / 50)
    if numerics.step_travel is not None:
        longest = min(longest, numerics.step_travel)
    elif scene.effects.friction is not None:
        longest = min(longest, unit / 40)
    shortest = np.inf
    if scene.effects.viscosity is not None:
        shortest = min(scene.effects.viscosity.times)
    return Path(
        corners=np.concatenate([start[None], tip]),
        times=np.concatenate([[0.0], np.asarray(scene.motion.time)]),
        longest=longest / unit,
        shortest_time=shortest,
        halvings_max=numerics.halvings,
    )
