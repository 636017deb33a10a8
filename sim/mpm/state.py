# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Batch of presses on the device: particles, grids and time steps, and their kernels."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from sim.indenters.device import PLAIN, PartTable, Traits, distance_function, table_struct
from sim.mpm.lattice import BASE_NODE, Lattice, Pace
from sim.mpm.numerics import DET_FLOOR, REACH, Mpm
from sim.scalars import PRECISIONS, det_less_one_function, matrix_of, numpy_of, vector_of
from sim.scene import Scene

# Quadratic B-spline that couples a particle to 27 grid nodes, and fixed-point sums at the nodes.
#
# Weights and their affine moment: Jiang et al., The affine particle-in-cell method (2015), section
# 5; for this spline the moment of inertia is a quarter of a cell squared along each axis.

# Fixed-point units per 1 of the integers in which nodes sum up mass and momentum.
#
# Integer sums are the same to the last bit in any order, so a run is repeatable on every device.
# One unit is 2e-16, the range is +-2,048; in units of cells and time steps a node's mass is about 1
# and speeds are below 0.5. Larger units would slow a slow body: the conversion truncates towards 0.
FIXED_POINT = 2.0**52
# One over the spline's moment of inertia [1/cell^2].
MOMENT = 4.0


@functools.cache
def spline_functions(real):
    """Return `first_node`, `weights` and `arms` of the spline.

    `first_node(x)` also returns the offset from that node; `weights` and `arms` (offsets to all
    nodes) are functions of this offset. Rows of their matrices are axes, columns the three nodes
    along each.
    """
    vec3, mat33 = vector_of(real), matrix_of(real)
    half, one, two = real(0.5), real(1.0), real(2.0)

    @wp.func
    def first_node(x: vec3):
        low = vec3(wp.floor(x[0] - half), wp.floor(x[1] - half), wp.floor(x[2] - half))
        return wp.vec3i(int(low[0]), int(low[1]), int(low[2])), x - low

    @wp.func
    def weights(from_first: vec3):
        found = mat33()
        for axis in range(3):
            f = from_first[axis]
            below = real(1.5) - f
            above = f - half
            found[axis, 0] = half * below * below
            found[axis, 1] = real(0.75) - (f - one) * (f - one)
            found[axis, 2] = half * above * above
        return found

    @wp.func
    def arms(from_first: vec3):
        found = mat33()
        for axis in range(3):
            found[axis, 0] = -from_first[axis]
            found[axis, 1] = one - from_first[axis]
            found[axis, 2] = two - from_first[axis]
        return found

    return first_node, weights, arms


# Impulses of a step: force of the indenter, its torque about the tip, force of the base.
READINGS = 9
# Fixed-point units per 1 of these sums: one unit is 1e-12, the range is +-8 million.
IMPULSE_UNIT = 2.0**40


# Time step of a grid node: velocity from momentum, the bonded base, the rigid indenter.
#
# The base: inside the body the velocity field is extended below the base plane as an odd function,
# so that a spline over nodes on both sides of it vanishes there. The first node below is tied to
# the first above: they share one unknown, and its mass and momentum are gathered from both.


@functools.cache
def node_kernel(real, sticky: bool, friction: bool, bonded: bool, traits: Traits = PLAIN):
    """Return the kernel of a node's time step for one precision, contact law, base and traits."""
    vec3 = vector_of(real)
    table_type = table_struct(real, traits)
    distance = distance_function(real, traits)
    zero, unit = real(0.0), real(FIXED_POINT)
    impulse_unit = real(IMPULSE_UNIT)
    base = BASE_NODE

    @wp.kernel(enable_backward=False, module="unique")
    def step_nodes(
        # Settings:
        nodes: wp.vec3i,
        corner: wp.vec3i,
        origin: vec3,
        reach: real,
        # Indenter:
        table: table_type,
        coefficient: wp.array(dtype=real),
        tip: wp.array(dtype=vec3),
        tip_velocity: wp.array(dtype=vec3),
        # Environments:
        active: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
        # In, and cleared for the next step:
        sums: wp.array3d(dtype=wp.int64),
        # Out:
        velocity_out: wp.array2d(dtype=vec3),
        history_out: wp.array3d(dtype=wp.int64),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        k = n % nodes[2]
        if wp.static(bonded) and k == base - 1:
            return
        # Nodes that received nothing need no clearing, and no particle reads their old velocity.
        some = sums[env, n, 0] | sums[env, n, 1] | sums[env, n, 2] | sums[env, n, 3]
        if some == wp.int64(0) and not (wp.static(bonded) and k == base + 1):
            return
        mass = real(sums[env, n, 0]) / unit
        px = real(sums[env, n, 1]) / unit
        py = real(sums[env, n, 2]) / unit
        pz = real(sums[env, n, 3]) / unit
        for c in range(4):
            sums[env, n, c] = wp.int64(0)
        momentum = vec3(px, py, pz)
        before = momentum
        below = zero
        if wp.static(bonded) and k == base + 1:
            below = real(sums[env, n - 2, 0]) / unit
            qx = real(sums[env, n - 2, 1]) / unit
            qy = real(sums[env, n - 2, 2]) / unit
            qz = real(sums[env, n - 2, 3]) / unit
            for c in range(4):
                sums[env, n - 2, c] = wp.int64(0)
            momentum -= vec3(qx, qy, qz)
            before += vec3(qx, qy, qz)
        v = vec3()
        slot = step[env] % history_out.shape[1]
        if mass + below > zero:
            v = momentum / (mass + below)
            pushed = vec3()
            if wp.static(bonded) and k <= base:
                v = vec3()
            else:
                i = n // (nodes[1] * nodes[2]) - corner[0]
                j = (n // nodes[2]) % nodes[1] - corner[1]
                place = vec3(real(i), real(j), real(k - corner[2]))
                lever = place - origin - tip[env]
                answer = distance(table, env, lever)
                if answer[3] < reach:
                    relative = v - tip_velocity[env]
                    change = vec3()
                    if wp.static(sticky):
                        change = -relative
                    else:
                        normal = vec3(answer[0], answer[1], answer[2])
                        approach = wp.dot(relative, normal)
                        if approach < zero:
                            change = -normal * approach
                            if wp.static(friction):
                                slip = relative - normal * approach
                                size = wp.length(slip)
                                most = -coefficient[env] * approach
                                if size <= most:
                                    change -= slip
                                else:
                                    change -= slip * (most / size)
                    v += change
                    pushed = change * (mass + below)
                    turned = wp.cross(lever, pushed)
                    for c in range(3):
                        wp.atomic_add(history_out, env, slot, c, wp.int64(pushed[c] * impulse_unit))
                        wp.atomic_add(
                            history_out, env, slot, 3 + c, wp.int64(turned[c] * impulse_unit)
                        )
            if wp.static(bonded) and k <= base + 1:
                held = v * (mass - below) - before - pushed
                for c in range(3):
                    wp.atomic_add(history_out, env, slot, 6 + c, wp.int64(held[c] * impulse_unit))
        velocity_out[env, n] = v
        if wp.static(bonded) and k == base + 1:
            velocity_out[env, n - 2] = -v

    return step_nodes


# Neo-Hookean law of `Body`, from the displacement gradient H = F - I.
#
# Written in H, no term that is 1 at rest is ever rounded: a body at rest has exactly no stress, and
# float32 keeps its digits at small strain.


@functools.cache
def law_functions(real):
    """Return `dilatation(H)` = det(F) - 1, `kirchhoff(H, G, K)`, `energy(H, G, K)` per volume."""
    mat33 = matrix_of(real)
    one, half, third = real(1.0), real(0.5), real(1.0 / 3.0)
    # Inside a kernel quotients are computed in float32.
    power = real(-2.0 / 3.0)

    dilatation = det_less_one_function(real)

    @wp.func
    def kirchhoff(h: mat33, shear: real, bulk: real):
        grown = dilatation(h)
        strain = h + wp.transpose(h) + h * wp.transpose(h)
        isochoric = shear * wp.pow(one + grown, power)
        pressure = half * bulk * grown * (real(2.0) + grown)
        identity = wp.identity(n=3, dtype=real)
        return strain * isochoric + identity * (pressure - isochoric * third * wp.trace(strain))

    @wp.func
    def energy(h: mat33, shear: real, bulk: real):
        grown = dilatation(h)
        strain = h + wp.transpose(h) + h * wp.transpose(h)
        size = one + grown
        # J^(-2/3) (tr b - 3) + 3 (J^(-2/3) - 1), the second from ln J so that it keeps its digits.
        log = wp.log(size)
        shrunk = wp.exp(log * power)
        isochoric = wp.trace(strain) * shrunk + real(3.0) * (shrunk - one)
        volumetric = half * grown * (real(2.0) + grown) - log
        return half * (shear * isochoric + bulk * volumetric)

    return dilatation, kirchhoff, energy


# Position of each tip after the next time step, and the check if its environment takes that step.


@functools.cache
def tip_kernel(real):
    """Return the kernel that begins a time step, for one precision."""
    vec3 = vector_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def begin_step(
        # Schedule: corners [cells], and the numbers of the steps that end there
        corners: wp.array2d(dtype=vec3),
        at: wp.array2d(dtype=wp.int32),
        # In:
        status: wp.array(dtype=wp.int32),
        # In and out: steps taken
        step: wp.array(dtype=wp.int32),
        # Out:
        active_out: wp.array(dtype=wp.int32),
        tip_out: wp.array(dtype=vec3),
        velocity_out: wp.array(dtype=vec3),
    ):
        env = wp.tid()
        last = at.shape[1] - 1
        now = step[env] + 1
        if status[env] != 0 or now > at[env, last]:
            active_out[env] = 0
            return
        active_out[env] = 1
        step[env] = now
        if now <= at[env, 0]:
            tip_out[env] = corners[env, 0]
            velocity_out[env] = vec3()
            return
        segment = wp.int32(0)
        while segment < last - 1 and now > at[env, segment + 1]:
            segment += 1
        travel = corners[env, segment + 1] - corners[env, segment]
        steps = real(at[env, segment + 1] - at[env, segment])
        left = real(at[env, segment + 1] - now)
        tip_out[env] = corners[env, segment + 1] - travel * (left / steps)
        velocity_out[env] = travel / steps

    return begin_step


# Time step of a particle: take velocity and its gradient from the grid, move, return momentum.
#
# MLS-MPM (Hu et al., A moving least squares material point method, 2018, eq. 16) with affine
# transfers. Both transfers are one kernel: velocity and its gradient stay in registers between
# them, and a particle stores only its displacement and its displacement gradient. Lengths are in
# cells, times in time steps, masses in that of a cell of the material.

# Reasons for which a simulation ends early.
LEFT_GRID, COLLAPSED, TOO_FAST = 1, 2, 3
# Most cells that a particle may move in a step: far beyond any stable motion.
SPEED_LIMIT = 0.5


@functools.cache
def particle_kernel(real):
    """Return the kernel of a particle's time step, for one precision."""
    vec3, mat33 = vector_of(real), matrix_of(real)
    first_node, weights, arms = spline_functions(real)
    dilatation, kirchhoff, _energy = law_functions(real)
    one, moment, unit = real(1.0), real(MOMENT), real(FIXED_POINT)

    @wp.kernel(enable_backward=False, module="unique")
    def move(
        # Settings:
        nodes: wp.vec3i,
        corner: wp.vec3i,
        held: int,
        det_floor: real,
        # Particles, shared by all environments:
        rest: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        # Environments:
        active: wp.array(dtype=wp.int32),
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        # In:
        velocity: wp.array2d(dtype=vec3),
        # In and out: displacement, and its gradient
        shift: wp.array2d(dtype=vec3),
        gradient: wp.array2d(dtype=mat33),
        # Out: mass and momentum at nodes, and the reason for which an environment ended
        sums_out: wp.array3d(dtype=wp.int64),
        status_out: wp.array(dtype=wp.int32),
    ):
        env, p = wp.tid()
        if active[env] == 0:
            return
        u = shift[env, p]
        x = rest[p] + u
        first, offset = first_node(x)
        first += corner
        w = weights(offset)
        arm = arms(offset)
        v = vec3()
        affine = mat33()
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    fraction = velocity[env, row + k] * (w[0, i] * w[1, j] * w[2, k])
                    v += fraction
                    affine += wp.outer(fraction, vec3(arm[0, i], arm[1, j], arm[2, k]))
        affine = affine * moment
        if p < held:
            v = vec3()
        u += v
        h = gradient[env, p]
        h += affine + affine * h
        shift[env, p] = u
        gradient[env, p] = h

        # Written so that a NaN fails every check.
        if not (wp.length_sq(v) < real(SPEED_LIMIT * SPEED_LIMIT)):
            wp.atomic_max(status_out, env, TOO_FAST)
            return
        if not (one + dilatation(h) > det_floor):
            wp.atomic_max(status_out, env, COLLAPSED)
            return
        x = rest[p] + u
        first, offset = first_node(x)
        first += corner
        for axis in range(3):
            if first[axis] < 0 or first[axis] + 2 >= nodes[axis]:
                wp.atomic_max(status_out, env, LEFT_GRID)
                return

        w = weights(offset)
        arm = arms(offset)
        mass = volume[p]
        push = affine * mass - kirchhoff(h, shear[env], bulk[env]) * (moment * mass)
        momentum = v * mass
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    weight = w[0, i] * w[1, j] * w[2, k] * unit
                    given = (momentum + push * vec3(arm[0, i], arm[1, j], arm[2, k])) * weight
                    wp.atomic_add(sums_out, env, row + k, 0, wp.int64(mass * weight))
                    wp.atomic_add(sums_out, env, row + k, 1, wp.int64(given[0]))
                    wp.atomic_add(sums_out, env, row + k, 2, wp.int64(given[1]))
                    wp.atomic_add(sums_out, env, row + k, 3, wp.int64(given[2]))

    return move


# Readings of the particles at a waypoint: surface, energy, and compression of the material.


@functools.cache
def reading_kernels(real):
    """Return the kernels of the surface's displacement and of sums over the body."""
    vec3, mat33 = vector_of(real), matrix_of(real)
    first_node, weights, _arms = spline_functions(real)
    dilatation, _kirchhoff, energy = law_functions(real)
    one, half, unit = real(1.0), real(0.5), real(FIXED_POINT)

    @wp.kernel(enable_backward=False, module="unique")
    def surface(
        # Particles: the first of the highest layer, and offsets from that layer to the surface
        first: int,
        to_surface: wp.array(dtype=vec3),
        # In:
        shift: wp.array2d(dtype=vec3),
        gradient: wp.array2d(dtype=mat33),
        # Out: displacement of the surface
        surface_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        bent = gradient[env, first + n] * to_surface[n]
        surface_out[env, n] = shift[env, first + n] + bent

    @wp.kernel(enable_backward=False, module="unique")
    def body(
        # Settings:
        nodes: wp.vec3i,
        corner: wp.vec3i,
        # Particles:
        rest: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        whole: real,
        # Environments:
        status: wp.array(dtype=wp.int32),
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        # In:
        velocity: wp.array2d(dtype=vec3),
        shift: wp.array2d(dtype=vec3),
        gradient: wp.array2d(dtype=mat33),
        # Out: means over the body of stored and kinetic energy,
        # and the smallest determinant
        sums_out: wp.array2d(dtype=wp.int64),
        det_out: wp.array(dtype=real),
    ):
        env, p = wp.tid()
        if status[env] != 0:
            return
        h = gradient[env, p]
        first, offset = first_node(rest[p] + shift[env, p])
        first += corner
        w = weights(offset)
        v = vec3()
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    v += velocity[env, row + k] * (w[0, i] * w[1, j] * w[2, k])
        fraction = volume[p] / whole * unit
        stored = energy(h, shear[env], bulk[env]) * fraction
        wp.atomic_add(sums_out, env, 0, wp.int64(stored))
        wp.atomic_add(sums_out, env, 1, wp.int64(half * wp.length_sq(v) * fraction))
        wp.atomic_min(det_out, env, one + dilatation(h))

    return surface, body


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
        self._fill_environments(scenes, numerics)
        self._fill_schedules(paces)

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=self.device)

        self.shift = zeros((count, particles), vec3)
        self.gradient = zeros((count, particles), matrix_of(real))
        self.velocity = zeros((count, nodes), vec3)
        self.sums = zeros((count, nodes, 4), wp.int64)
        self.history = zeros((count, ROUND, READINGS), wp.int64)
        self._surface = zeros((count, len(lattice.to_surface)), vec3)
        self._means = zeros((count, 2), wp.int64)
        self._det = zeros(count, real)
        self.active = wp.full(count, 1, dtype=wp.int32, device=self.device)
        self.status, self.step = zeros(count, wp.int32), zeros(count, wp.int32)
        self.tip, self.tip_velocity = zeros(count, vec3), zeros(count, vec3)
        self.nodes, self._corner = wp.vec3i(*lattice.nodes), wp.vec3i(*lattice.corner)
        self._held, self._det_floor = lattice.held, real(DET_FLOOR)
        self._origin, self._reach = (
            vec3(*lattice.origin),
            real(REACH if numerics.published is None else 0.0),
        )
        self._graph = None
        # Initial sums of the grid: a time step of particles at rest changes nothing else.
        self.move_particles()

    def _fill_environments(self, scenes, numerics) -> None:
        """Set the parameters of each environment: material and contact."""
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
        self._node_kernel = node_kernel(
            real,
            numerics.published is not None,
            friction[0] is not None,
            numerics.published is None,
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
            [self._corners, self._at, self.status, self.step],
            [self.active, self.tip, self.tip_velocity],
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
                self.active, self.step, self.sums,
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
        """Return energies and smallest determinant of every environment."""
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
            Means(float(one[0]), float(one[1]), float(least))
            for one, least in zip(means, det, strict=True)
        ]
