# mypy: ignore-errors
# Reads Warp arrays, typed at run time; mypy cannot follow them.
"""What is kept of an accepted state: force, surface, and how far it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.fem.assembly import Assembly
from sim.fem.mesh import Mesh
from sim.fem.newton import FORCE_FLOOR
from sim.fem.readings import Snapshot, body_force, contact_points, stored_energy, surface_traction
from sim.result import Quality, Result
from sim.scene import Scene


@dataclass(slots=True)
class Spent:
    """What the steps to the next frame have cost one press."""

    newton: int = 0
    cg: int = 0
    steps: int = 0


class Collector:
    """Frames of one press, filled as they are reached; SI units outside."""

    def __init__(self, scene: Scene, mesh: Mesh, assembly: Assembly) -> None:
        self._scene, self._mesh = scene, mesh
        self._unit = scene.body.thickness
        self._stress = scene.body.modulus
        nx, ny, _nz = mesh.cells
        frames = len(scene.motion)
        self._wrench = np.full((frames, 6), np.nan)
        self._surface = np.full((frames, nx + 1, ny + 1, 3), np.nan, np.float32)
        self._traction = np.full((frames, nx + 1, ny + 1, 3), np.nan, np.float32)
        self._quality = {
            name: np.full(frames, np.nan)
            for name in ("residual", "contact", "balance", "energy_gap", "det_f_min", "slip_excess")
        }
        self._counts = {name: np.zeros(frames, np.int64) for name in ("newton", "cg", "steps")}
        self._work, self._work_most = 0.0, 0.0
        self._force_before, self._tip_before = np.zeros(3), None
        self._start: float | None = None
        self.spent = Spent()

    def moved(self, tip: np.ndarray, force: np.ndarray) -> None:
        """Count the work of a step that ended with the tip at `tip`, pushing with `force` (3,)."""
        if self._tip_before is not None:
            self._work += 0.5 * float((force + self._force_before) @ (tip - self._tip_before))
            self._work_most = max(self._work_most, self._work)
        self._force_before, self._tip_before = force.copy(), tip.copy()

    def keep(self, frame: int, env: int, held: Snapshot, residual: float) -> None:
        """Keep the state of environment `env`, last evaluated, as frame `frame`."""
        assembly, mesh = held.assembly, self._mesh
        u = held.of(env, assembly.state.u).astype(float)
        tip = self._tip_before
        points = contact_points(held, env, u)
        force = points.force.sum(axis=(0, 1))
        lever = points.place - tip
        torque = np.cross(lever, points.force).sum(axis=(0, 1))
        unit, push = self._unit, self._stress * self._unit**2
        self._wrench[frame, :3] = force * push
        self._wrench[frame, 3:] = torque * push * unit
        self._surface[frame] = u[mesh.top] * unit
        self._traction[frame] = surface_traction(held, env) * self._stress
        depth = max(-float(tip[2]), 1e-6)
        size = float(np.linalg.norm(force))
        external = force + body_force(held, env, u)
        quality = self._quality
        quality["residual"][frame] = residual
        quality["contact"][frame] = points.penetration.max(initial=0.0) / depth
        scale = max(size, float(np.linalg.norm(external)), FORCE_FLOOR[assembly.precision])
        quality["balance"][frame] = (
            float(np.linalg.norm(external + assembly.sums.base[env])) / scale
        )
        stored = stored_energy(held, env, points, u)
        if self._start is None:
            self._start, self._work, self._work_most = stored, 0.0, 0.0
        lost = self._work - (stored - self._start)
        quality["energy_gap"][frame] = lost / self._work_most if self._work_most > 1e-9 else 0.0
        quality["det_f_min"][frame] = assembly.sums.det[env]
        quality["slip_excess"][frame] = points.slip_excess
        for name in self._counts:
            self._counts[name][frame] = getattr(self.spent, name)
        self.spent = Spent()

    def result(self, record: dict) -> Result:
        """The result, once every frame was kept."""
        return Result(
            scene=self._scene,
            tier="fem",
            wrench=self._wrench,
            surface_x=self._mesh.x * self._unit,
            surface_y=self._mesh.y * self._unit,
            surface=self._surface,
            traction=self._traction,
            quality=Quality(**self._quality, **self._counts),
            record=record,
        )
