# mypy: ignore-errors
# Drives Warp arrays, typed at run time; mypy cannot follow them.
"""Batch of presses on the device: particles, grids, and time steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from sim.indenters.device import PartTable
from sim.mpm.kernels import (
    FIXED_POINT,
    IMPULSE_UNIT,
    READINGS,
    node_kernel,
    particle_kernel,
    reading_kernels,
    tip_kernel,
)
from sim.mpm.lattice import Lattice, Pace
from sim.mpm.numerics import Mpm
from sim.scalars import PRECISIONS, matrix_of, numpy_of, vector_of
from sim.scene import Scene

# Steps between two reads from the device, and per captured graph.
ROUND = 64
# Gaps beyond this may be underestimated [cells].
FAR = 2.0


@dataclass(frozen=True, slots=True)
class Units:
    """SI values of an environment's units; lengths are in cells, times in time steps."""

    length: float
    """Edge of a cell [m]."""
    time: float
    """Duration of a time step [s]."""
    density: float
    """Density of the material, with scaled mass [kg/m^3]."""

    @property
    def stress(self) -> float:
        """Stress [Pa]."""
        return self.density * (self.length / self.time) ** 2

    @property
    def force(self) -> float:
        """Force [N]; an impulse of one step has the same number."""
        return self.stress * self.length**2


@dataclass(frozen=True, slots=True)
class Means:
    """Means over the body in one environment, and its smallest determinant."""

    stored: float
    """Elastic energy per rest volume."""
    kinetic: float
    displacement: np.ndarray
    """Displacement (3,)."""
    det_min: float


class ParticleState:
    """Particles and grids of a batch; environments end with their schedule or with a failure.

    Memory per environment: 48 bytes a particle and 44 a node in float32, 96 and 56 in float64.
    """

    def __init__(
        self,
        lattice: Lattice,
        scenes: Sequence[Scene],
        paces: Sequence[Pace],
        numerics: Mpm,
        device: str,
    ) -> None:
        self.lattice, self.device = lattice, wp.get_device(device)
        self.real = real = PRECISIONS[numerics.precision]
        self.vec3 = vec3 = vector_of(real)
        self.units = [
            Units(lattice.cell, pace.time_step, scene.body.density * pace.mass_scaling)
            for scene, pace in zip(scenes, paces, strict=True)
        ]
        count, particles, nodes = len(scenes), len(lattice.rest), lattice.node_count
        self._count, self._particles = count, particles
        self.rest = self.array(lattice.rest, vec3)
        self.volume = self.array(lattice.volume, real)
        self._to_surface = self.array(lattice.to_surface, vec3)
        self._fill_environments(scenes, paces, numerics)
        self._fill_schedules(paces)

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=self.device)

        self.shift = zeros((count, particles), vec3)
        self.gradient = zeros((count, particles), matrix_of(real))
        self.velocity = zeros((count, nodes), vec3)
        self.sums = zeros((count, nodes, 4), wp.int64)
        self.history = zeros((count, ROUND, READINGS), wp.int64)
        self._surface = zeros((count, len(lattice.to_surface)), vec3)
        self._means = zeros((count, 5), wp.int64)
        self._det = zeros(count, real)
        self.active = wp.full(count, 1, dtype=wp.int32, device=self.device)
        self.status, self.step = zeros(count, wp.int32), zeros(count, wp.int32)
        self.tip, self.tip_velocity = zeros(count, vec3), zeros(count, vec3)
        self.damping = zeros(count, real)
        self.nodes, self._corner = wp.vec3i(*lattice.nodes), wp.vec3i(*lattice.corner)
        self._held, self._det_floor = lattice.held, real(numerics.det_floor)
        self._origin, self._reach = vec3(*lattice.origin), real(numerics.reach)
        self._graph = None
        # Initial sums of the grid: a time step of particles at rest changes nothing else.
        self.move_particles()

    def _fill_environments(self, scenes, paces, numerics) -> None:
        """Set the parameters of each environment: material, contact, weight."""
        real, units = self.real, self.units
        stress = np.array([unit.stress for unit in units])
        self.shear = self.array([one.body.shear_modulus for one in scenes] / stress, real)
        self.bulk = self.array([one.body.bulk_modulus for one in scenes] / stress, real)
        indenters = [one.indenter for one in scenes]
        cell = self.lattice.cell
        self._table = PartTable.pack(indenters, cell, real, self.device, far=FAR * cell)
        friction = [one.effects.friction for one in scenes]
        given = [0.0 if one is None else one.coefficient for one in friction]
        self._coefficient = self.array(given, real)
        weight = np.zeros((len(scenes), 3))
        for env, (scene, unit, pace) in enumerate(zip(scenes, units, paces, strict=True)):
            if scene.effects.gravity is not None:
                # Weight is that of the real mass, so a scaled one falls more slowly.
                fall = np.array(scene.effects.gravity.acceleration) / pace.mass_scaling
                weight[env] = fall * unit.time**2 / unit.length
        self._weight = self.array(weight, self.vec3)
        self._node_kernel = node_kernel(
            real,
            numerics.contact == "sticky",
            friction[0] is not None,
            scenes[0].effects.gravity is not None,
            numerics.base == "grid",
            self._table.traits,
        )

    def _fill_schedules(self, paces: Sequence[Pace]) -> None:
        """Set corners and steps of every environment, padded with their last to the longest."""
        longest = max(len(pace.at) for pace in paces)
        corners = np.stack(
            [np.pad(pace.corners, ((0, longest - len(pace.at)), (0, 0)), "edge") for pace in paces]
        )
        at = np.stack([np.pad(pace.at, (0, longest - len(pace.at)), "edge") for pace in paces])
        self._corners = self.array(corners / self.lattice.cell, self.vec3)
        self._at = self.array(at, wp.int32)
        self._settling = self.array([pace.settling for pace in paces], self.real)

    def array(self, values, dtype) -> wp.array:
        """Return values as an array on the device."""
        plain = np.int32 if dtype is wp.int32 else numpy_of(self.real)
        return wp.array(np.asarray(values, plain), dtype=dtype, device=self.device)

    @property
    def bytes(self) -> int:
        """Memory of all arrays [bytes]."""
        arrays = [value for value in vars(self).values() if isinstance(value, wp.array)]
        return sum(array.capacity for array in arrays)

    def advance(self, steps: int) -> np.ndarray:
        """Take up to `ROUND` steps; return their readings (steps, environments, 9) [cells, steps].

        Readings of environments that have ended are 0.
        """
        self.history.zero_()
        before = int(self.step.numpy().max())
        if steps == ROUND and self.device.is_cuda:
            self._replay()
        else:
            for _ in range(steps):
                self._one_step()
        slots = (before + 1 + np.arange(steps)) % ROUND
        return np.moveaxis(self.history.numpy()[:, slots], 0, 1) / IMPULSE_UNIT

    def _replay(self) -> None:
        """Run `ROUND` steps as one graph; the first time run them directly and record the graph."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        # The steps before have loaded the kernels: a capture must not load any.
        self._one_step()
        with wp.ScopedCapture(device=self.device) as capture:
            for _ in range(ROUND):
                self._one_step()
        self._graph = capture.graph
        for _ in range(ROUND - 1):
            self._one_step()

    def _one_step(self) -> None:
        self.begin_step()
        self.step_nodes()
        self.move_particles()

    def begin_step(self) -> None:
        """Advance the tips and determine which environments take a step."""
        wp.launch(
            tip_kernel(self.real),
            self._count,
            [self._corners, self._at, self._settling, self.status, self.step],
            [self.active, self.tip, self.tip_velocity, self.damping],
            device=self.device,
        )

    def step_nodes(self) -> None:
        """Compute velocities of the nodes from mass and momentum of the particles."""
        wp.launch(
            self._node_kernel,
            (self._count, self.lattice.node_count),
            [
                self.nodes, self._corner, self._origin, self._reach,
                self._table.struct, self._coefficient, self.tip, self.tip_velocity,
                self.active, self.step, self._weight, self.damping, self.sums,
            ],
            [self.velocity, self.history],
            device=self.device,
        )  # fmt: skip

    def move_particles(self) -> None:
        """Displace and deform the particles, and transfer their mass and momentum to the nodes."""
        wp.launch(
            particle_kernel(self.real),
            (self._count, self._particles),
            [
                self.nodes, self._corner, self._held, self._det_floor, self.rest, self.volume,
                self.active, self.shear, self.bulk, self.velocity, self.shift, self.gradient,
            ],
            [self.sums, self.status],
            device=self.device,
        )  # fmt: skip

    def surface(self) -> np.ndarray:
        """Return displacements of the top of all environments (environments, X, Y, 3) [cells]."""
        kernel, _ = reading_kernels(self.real)
        size = len(self.lattice.to_surface)
        wp.launch(
            kernel,
            (self._count, size),
            [self._particles - size, self._to_surface, self.shift, self.gradient],
            [self._surface],
            device=self.device,
        )
        nx, ny, _nz = self.lattice.counts
        return self._surface.numpy().reshape(self._count, nx, ny, 3).astype(float)

    def means(self) -> list[Means]:
        """Return energies, displacement and smallest determinant of every environment."""
        _, kernel = reading_kernels(self.real)
        whole = self.real(self.lattice.volume.sum())
        self._means.zero_()
        self._det.fill_(float("inf"))
        wp.launch(
            kernel,
            (self._count, self._particles),
            [
                self.nodes, self._corner, self.rest, self.volume, whole,
                self.status, self.shear, self.bulk, self.velocity, self.shift, self.gradient,
            ],
            [self._means, self._det],
            device=self.device,
        )  # fmt: skip
        means, det = self._means.numpy() / FIXED_POINT, self._det.numpy().astype(float)
        return [
            Means(float(one[0]), float(one[1]), one[2:], float(least))
            for one, least in zip(means, det, strict=True)
        ]
