"""Frames of presses: stored as they are read from the device, and their results in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree

from sim.fem.balance import READ
from sim.fem.mesh import Mesh
from sim.fem.sizing import resolved
from sim.result import Quality, Result, touched_by, width_of
from sim.scene import Scene

Array = NDArray[np.float64]

# A round body on a grid: values at nodes outside it, and contact at its side wall.


class Round:
    """Side wall of a round body, which cuts through elements and is no contact face."""

    def __init__(self, scene: Scene, mesh: Mesh) -> None:
        self._scene, self._mesh = scene, mesh
        unit, body = scene.body.thickness, scene.body
        beside = mesh.beside
        places = np.stack(np.meshgrid(mesh.x, mesh.y, indexing="ij"), axis=-1)
        self._nearest = KDTree(places[~beside]).query(places)[1]
        """Index of the body's nearest column of nodes, for each column (X, Y)."""
        self._of_body = np.flatnonzero(~beside)
        fraction = np.asarray(mesh.fraction)
        self._cut = ((fraction > 0) & (fraction < 1)).ravel()
        angle = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
        self._wall = np.stack([np.cos(angle), np.sin(angle)], axis=1) / (2 * unit)
        self._wall *= body.size_x, body.size_y
        low, high = np.array([mesh.x[[0, -1]], mesh.y[[0, -1]]]).T
        self._wall = np.clip(self._wall, low, high)  # rounding may put them outside
        rim = np.array([body.height(*place) for place in self._wall * unit]) / unit
        fraction = 1.0 + mesh.nodes[mesh.top[0, 0] - mesh.cells[2] : mesh.top[0, 0] + 1, 2]
        self._levels = -1.0 + (1.0 + rim)[:, None] * (fraction / fraction[-1])

    def continued(self, u: Array) -> Array:
        """Return displacements (N, 3) by column (X, Y, Z, 3), extended beyond the body's edge.

        Nodes without material have no displacement; a curve through zeros there would bend on the
        gel.
        """
        columns = u.reshape(self._nearest.size, -1, 3)
        every = columns[self._of_body[self._nearest]]
        return np.asarray(every.reshape(*self._nearest.shape, -1, 3))

    def touched(self, faces: NDArray[np.int64]) -> bool:
        """True if a touched face of the top (T,) is in a column that the side cuts through."""
        return bool(self._cut[faces[faces < len(self._cut)]].any())

    def wall(self, columns: Array) -> Array:
        """Return points (W, Z, 3) of the side wall, displaced by `continued` (X, Y, Z, 3)."""
        look = RegularGridInterpolator((self._mesh.x, self._mesh.y), columns)
        moved = np.asarray(look(self._wall))
        moved[..., :2] += self._wall[:, None]
        moved[..., 2] += self._levels
        return moved

    def overlapped(self, wall: Array, tip: Array) -> bool:
        """True if the indenter overlaps the side wall (W, Z, 3), whose upper edge is the top's."""
        under = (wall[:, :-1] - tip) * self._scene.body.thickness
        return bool((self._scene.indenter.distance(under)[0] < 0).any())


# Points around a round side wall that are tested for overlap with the indenter.
AROUND = 256


# Frames of one press.


@dataclass(slots=True)
class Spent:
    """Cost of the steps to the next frame of one press."""

    newton: int = 0
    cg: int = 0
    steps: int = 0


TOLD = np.dtype(
    [
        ("depth", float),
        ("residual", float),
        ("base", float, 3),
        ("det", float),
        ("min_force_scale", float),
        ("self_overlap", float),
        ("self_node", int),
        ("work", float),
        ("work_most", float),
        ("overlap_path", float),
        ("newton", int),
        ("cg", int),
        ("steps", int),
    ]
)
"""Values of a frame beside `READ`, in units of thickness and modulus: depth of the tip, residual,
force of the base on the body, least determinant, least force by which residuals are divided,
results of `self_overlap`; work since the first frame, and the most of it so far; greatest overlap
along the steps to the frame; numbers of Newton iterations, of CG iterations and of steps."""


class Collector:
    """Frames of one press, filled as they are reached; the result is in SI units."""

    def __init__(self, scene: Scene, mesh: Mesh) -> None:
        self._scene, self._mesh = scene, mesh
        frames, shape = len(scene.motion), (len(mesh.x), len(mesh.y), 3)
        self._read, self._told = np.zeros(frames, READ), np.zeros(frames, TOLD)
        self._surface = np.full((frames, *shape), np.nan, np.float32)
        self._traction = np.full((frames, *shape), np.nan, np.float32)
        self._width, self._resolved = np.zeros((2, frames))
        self._unmeasured: list[int] = []
        self._touched: NDArray[np.bool_] | None = None
        """Contact of the frame that was measured last (X, Y), with this resolution."""
        self._resolution = np.inf
        self._work = self._work_most = self._overlap_path = 0.0
        self._below_base = 0.0
        self.round = None if mesh.fraction is None else Round(scene, mesh)
        """Side wall of a round body."""
        self._at_side: dict[str, list[int]] = {"rim": [], "wall": []}

    def moved(self, work: float, overlap: Array) -> None:
        """Add the work [E T^3] of a step, and the overlap along it, see `Assembly.overlap` (4,)."""
        self._work += work
        self._work_most = max(self._work_most, self._work)
        self._overlap_path = max(self._overlap_path, float(overlap[0]))
        self._below_base = max(self._below_base, float(overlap[2]))

    def keep(
        self, frame: int, read: np.void, surface: Array, traction: Array, told: tuple[Any, ...]
    ) -> None:
        """Store what was read of a frame, `READ`, and of the nodes of its top.

        These have displacements (X, Y, 3) [m] and tractions (X, Y, 3) [Pa]. `told` has the values
        of `TOLD` up to those of the steps to the frame, and its cost.
        """
        if not frame:
            self._work = self._work_most = 0.0
        steps = self._work, self._work_most, self._overlap_path
        spent = told[-1]
        self._read[frame], self._surface[frame], self._traction[frame] = read, surface, traction
        self._told[frame] = (*told[:-1], *steps, spent.newton, spent.cg, spent.steps)
        self._overlap_path = 0.0
        self._unmeasured.append(frame)

    def measure(self) -> None:
        """Measure the contacts of the frames stored since the last call: 1 ms each."""
        if not self._unmeasured:
            return
        mesh, body, unit = self._mesh, self._scene.body, self._scene.body.thickness
        x, y, top = mesh.x * unit, mesh.y * unit, mesh.topmost * unit
        for frame in self._unmeasured:
            traction = self._traction[frame]
            self._width[frame] = width_of((traction != 0).any(axis=-1), x, y)
            touched = touched_by(traction)
            if self._touched is None or (touched != self._touched).any():
                self._touched = touched
                self._resolution = float(resolved(touched[None], x, y, body=body, top=top)[0])
            self._resolved[frame] = self._resolution
        self._unmeasured.clear()

    def keep_round(self, frame: int, u: Array, touched: NDArray[np.int32], tip: Array) -> None:
        """Store what a frame of a round body has beside `keep`; nothing for other bodies.

        It has displacements (N, 3) [T], touched points of each face (S,) and a tip (3,) [T].
        """
        body = self.round
        if body is None:
            return
        columns = body.continued(u)
        self._surface[frame] = columns[:, :, -1] * self._scene.body.thickness
        if body.touched(np.flatnonzero(touched)):
            self._at_side["rim"].append(frame)
        wall = body.wall(columns)
        if body.overlapped(wall, tip):
            self._at_side["wall"].append(frame)
        self._below_base = max(self._below_base, -1.0 - float(wall[..., 2].min()))

    def record(self) -> dict[str, Any]:
        """Return the entries of the record that come from the frames, [m].

        `overlap` has the material point that was deepest inside the indenter, and the largest depth
        below the base plane; `self_overlap` the depth of the skin inside itself in each frame, and
        the deepest point; `rim` and `wall` the waypoints at which those of a round body are
        touched.
        """
        mesh, unit = self._mesh, self._scene.body.thickness
        face = int(self._read["face"][np.argmax(self._read["overlap"][:, 0])])
        place = mesh.nodes[mesh.faces[face]].mean(axis=0) * unit
        inside = self._told["self_overlap"] * unit
        own: dict[str, Any] = {"metres": [float(f"{one:.4g}") for one in inside]}
        if inside.any():
            node = int(self._told["self_node"][np.argmax(inside)])
            own["place"] = [float(one) for one in mesh.nodes[node] * unit]
        return {
            "overlap": {
                "place": [float(one) for one in place],
                "below_base": self._below_base * unit,
            },
            "self_overlap": own,
            **{name: frames for name, frames in self._at_side.items() if frames},
        }

    def resolved(self) -> list[float | None]:
        """Return the contact resolution of each frame, 1 for 12 elements; None without contact."""
        self.measure()
        return [float(one) if np.isfinite(one) else None for one in self._resolved]

    def result(self, record: dict[str, Any]) -> Result:
        """Return the result; every frame must have been kept."""
        self.measure()
        scene, mesh, unit = self._scene, self._mesh, self._scene.body.thickness
        read, told, push = self._read, self._told, scene.body.modulus * unit**2
        force, energy, most = read["force"], read["energy"], told["work_most"]
        external = force + read["body"]
        sizes = [np.linalg.norm(one, axis=1) for one in (force, external, external + told["base"])]
        scale = np.maximum(np.maximum(sizes[0], sizes[1]), told["min_force_scale"])
        lost = told["work"] - (energy - energy[0])
        slip = read["excess"] / np.maximum(read["pressure"], 1e-30)
        overlap = read["overlap"] * unit
        x, y = mesh.x * unit, mesh.y * unit
        quality = Quality(
            residual=told["residual"].copy(),
            contact=read["penetration"] / np.maximum(told["depth"], 1e-6),
            balance=sizes[2] / scale,
            energy_gap=np.where(most > 1e-9, lost / np.maximum(most, 1e-9), 0.0),
            det_f_min=told["det"].copy(),
            slip_excess=np.full(len(slip), np.nan) if scene.effects.friction is None else slip,
            overlap=overlap[:, 0].copy(),
            overlap_bound=overlap[:, 1].copy(),
            overlap_path=np.maximum(told["overlap_path"] * unit, overlap[:, 0]),
            contact_width=self._width.copy(),
            **{name: told[name].copy() for name in ("newton", "cg", "steps")},
        )
        return Result(
            scene=scene,
            tier="fem",
            wrench=np.concatenate([force * push, read["torque"] * push * unit], axis=1),
            surface_x=x,
            surface_y=y,
            surface=self._surface,
            traction=self._traction,
            quality=quality,
            record=record,
        )
