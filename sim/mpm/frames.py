# mypy: ignore-errors
# Reads Warp arrays, typed at run time; mypy cannot follow them.
"""What is kept of a press at its waypoints: force, surface, and how far it can be trusted."""

from __future__ import annotations

import numpy as np

from sim.mpm.pace import Pace
from sim.mpm.state import Means, State, Units
from sim.result import Quality, Result
from sim.scene import Scene

DEPTH_LEAST = 1e-6
"""Penetration is compared with the depth of the press, and with this where it is less [m]."""


def end_of_line(values: np.ndarray) -> np.ndarray:
    """End of the straight line fitted to rows (N, ...) of evenly spaced values: (...).

    Unlike their mean it does not lag behind values that rise evenly.
    """
    count = len(values)
    if count < 3:
        return values[-1]
    place = np.arange(count) - (count - 1) / 2
    weights = 1 / count + place * (place[-1] / (place @ place))
    return np.tensordot(weights, values, axes=1)


class Frames:
    """Frames of one press, filled as they are reached; SI units outside.

    `residual` and `slip_excess` stay NaN: nothing is solved for, and Coulomb's law holds node by
    node. `balance` is the rate of momentum over the force: what a press without inertia is from
    balance. With inertia it is no error, and NaN; so it is where held particles take the reaction.
    """

    def __init__(self, scene: Scene, pace: Pace, state: State, env: int) -> None:
        self._scene, self._pace, self._lattice, self._env = scene, pace, state.lattice, env
        self._units: Units = state.units[env]
        frames = len(scene.motion)
        nx, ny, _nz = state.lattice.counts
        self._wrench = np.full((frames, 6), np.nan)
        self._surface = np.full((frames, nx, ny, 3), np.nan, np.float32)
        names = ("residual", "contact", "balance", "energy_gap", "det_f_min", "slip_excess")
        self._quality = {name: np.full(frames, np.nan) for name in names}
        self._steps = np.zeros(frames, np.int64)
        self._readings = np.zeros((pace.steps, 9))
        self._velocity = _tip_velocity(pace, state.lattice.cell)
        self._kinetic_share = 0.0
        self._start: float | None = None
        self._work_most = 0.0

    @property
    def at(self) -> np.ndarray:
        """Steps after which a frame is to be kept (F,)."""
        return self._pace.at[1:]

    def read(self, first: int, readings: np.ndarray) -> None:
        """Take note of the impulses of steps `first` onwards (N, 9); those past the end are 0."""
        kept = self._readings[first : first + len(readings)]
        kept[:] = readings[: len(kept)]

    def keep(self, frame: int, surface: np.ndarray, means: Means) -> None:
        """Keep the state of this environment after step `at[frame]` as that frame."""
        units, pace, quality = self._units, self._pace, self._quality
        end, before = int(pace.at[frame + 1]), int(pace.at[frame])
        self._steps[frame] = end - (before if frame else 0)
        push, base = np.zeros(6), np.zeros(3)
        if end > 0:
            # A settled start counts as one stretch with the settling before it.
            first = max(end - max(pace.window, 1), min(before, end - 1))
            fitted = end_of_line(self._readings[first:end])
            push, base = fitted[:6], fitted[6:]
        self._wrench[frame, :3] = push[:3] * units.force
        self._wrench[frame, 3:] = push[3:] * units.force * units.length
        self._surface[frame] = surface * units.length
        size = float(np.linalg.norm(push[:3]))
        if self._scene.effects.inertia is None and not self._lattice.held and size > 0:
            total = push[:3] + base + self._weight()
            quality["balance"][frame] = float(np.linalg.norm(total)) / size
        quality["contact"][frame] = self._penetration(frame)
        quality["det_f_min"][frame] = means.det_min
        self._count_energy(frame, end, means)

    def _count_energy(self, frame: int, end: int, means: Means) -> None:
        volume = self._lattice.volume.sum()
        energy = (means.stored + means.kinetic) * volume - self._weight() @ means.displacement
        forces = self._readings[:end, :3]
        spent = np.concatenate([[0.0], np.cumsum((forces * self._velocity[:end]).sum(axis=1))])
        if self._start is None:
            self._start = energy - spent[-1]
        most = max(self._work_most, float(spent.max()))
        self._work_most = most
        lost = spent[-1] - (energy - self._start)
        self._quality["energy_gap"][frame] = lost / most if most > 0 else 0.0
        if means.stored > 0:
            self._kinetic_share = max(self._kinetic_share, means.kinetic / means.stored)

    def _weight(self) -> np.ndarray:
        """The body's weight (3,), as an impulse a step."""
        gravity = self._scene.effects.gravity
        if gravity is None:
            return np.zeros(3)
        mass = self._scene.body.density * self._lattice.volume.sum() * self._units.length**3
        return np.array(gravity.acceleration) * mass / self._units.force

    def _penetration(self, frame: int) -> float:
        """Deepest a point of the top lies inside the indenter, over the depth of the press."""
        lattice, body = self._lattice, self._scene.body
        place = np.zeros((*lattice.counts[:2], 3))
        place[..., 0], place[..., 1] = lattice.surface_x[:, None], lattice.surface_y
        place[..., 2] = body.heights(lattice.surface_x, lattice.surface_y)
        tip = np.asarray(self._scene.motion.tip[frame])
        gap, _ = self._scene.indenter.distance(place + self._surface[frame] - tip)
        return max(0.0, -float(gap.min())) / max(-float(tip[2]), DEPTH_LEAST)

    @property
    def lost(self) -> float:
        """Largest share of the work that was neither stored nor in motion."""
        return float(np.nanmax(self._quality["energy_gap"]))

    def result(self, record: dict) -> Result:
        """The result, once every frame was kept; no map of the traction, which is NaN."""
        return Result(
            scene=self._scene,
            tier="mpm",
            wrench=self._wrench,
            surface_x=self._lattice.surface_x,
            surface_y=self._lattice.surface_y,
            surface=self._surface,
            traction=np.full_like(self._surface, np.nan),
            quality=Quality(
                **self._quality,
                newton=np.zeros_like(self._steps),
                cg=np.zeros_like(self._steps),
                steps=self._steps,
            ),
            record={**record, "kinetic_over_stored": self._kinetic_share},
        )


def _tip_velocity(pace: Pace, cell: float) -> np.ndarray:
    """Way of the tip in each step (N, 3) [cells]."""
    velocity = np.zeros((pace.steps, 3))
    for k in range(1, len(pace.at)):
        first, last = pace.at[k - 1 : k + 1]
        if last > first:
            velocity[first:last] = (pace.corners[k] - pace.corners[k - 1]) / (last - first) / cell
    return velocity
