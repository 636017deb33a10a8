# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Batch of presses on the device: particles, grids and time steps, and their kernels."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from sim.indenters.device import PLAIN, IndenterTraits, PartTable, distance_function, table_struct
from sim.mpm import DET_FLOOR, REACH, Mpm
from sim.mpm.lattice import BASE_NODE, Pace, ParticleLattice
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
        matrix = mat33()
        for axis in range(3):
            f = from_first[axis]
            below = real(1.5) - f
            above = f - half
            matrix[axis, 0] = half * below * below
            matrix[axis, 1] = real(0.75) - (f - one) * (f - one)
            matrix[axis, 2] = half * above * above
        return matrix

    @wp.func
    def arms(from_first: vec3):
        matrix = mat33()
        for axis in range(3):
            matrix[axis, 0] = -from_first[axis]
            matrix[axis, 1] = one - from_first[axis]
            matrix[axis, 2] = two - from_first[axis]
        return matrix

    return first_node, weights, arms


@functools.cache
def batch_struct(real):
    """Return the struct of a batch: P particles, N nodes and a schedule in B environments."""
    vec3, mat33 = vector_of(real), matrix_of(real)

    class ParticleBatch:
        nodes: wp.vec3i  # number of nodes along each axis, and that of the body's corner
        corner: wp.vec3i
        origin: vec3  # of the contact frame
        reach: real  # distance from the indenter up to which nodes count as inside
        det_floor: real
        held: int  # fixed particles, which are the first
        rest: wp.array(dtype=vec3)  # particles (P,), in all environments
        volume: wp.array(dtype=real)
        to_surface: wp.array(dtype=vec3)  # offsets from particles of the highest layer to the top
        shear: wp.array(dtype=real)  # moduli (B,)
        bulk: wp.array(dtype=real)
        coefficient: wp.array(dtype=real)  # of friction (B,)
        corners: wp.array2d(dtype=vec3)  # of the tip's way, and the steps that end there
        at: wp.array2d(dtype=wp.int32)
        active: wp.array(dtype=wp.int32)  # 1 if a step is taken (B,)
        status: wp.array(dtype=wp.int32)  # reason for which an environment has ended, or 0 (B,)
        step: wp.array(dtype=wp.int32)  # steps taken (B,)
        tip: wp.array(dtype=vec3)  # and its displacement in a step (B,)
        tip_velocity: wp.array(dtype=vec3)
        shift: wp.array2d(dtype=vec3)  # displacement of the particles, and its gradient (B, P)
        gradient: wp.array2d(dtype=mat33)
        velocity: wp.array2d(dtype=vec3)  # of the nodes (B, N)
        sums: wp.array3d(dtype=wp.int64)  # mass and momentum at the nodes (B, N, 4)
        history: wp.array3d(dtype=wp.int64)  # impulses of the last steps (B, `ROUND`, `READINGS`)
        surface: wp.array2d(dtype=vec3)  # displacement of the top
        means: wp.array2d(dtype=wp.int64)  # stored and kinetic energy over the body (B, 2)
        det: wp.array(dtype=real)  # smallest determinant (B,)

    return wp.struct(ParticleBatch)


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
def node_kernel(real, published: bool, friction: bool, traits: IndenterTraits = PLAIN):
    """Return the kernel of a node's time step for one precision, contact law and traits.

    By the `published` settings contact is sticky, and the base is held by fixed particles.
    """
    bonded = not published
    vec3 = vector_of(real)
    table_type = table_struct(real, traits)
    distance = distance_function(real, traits)
    zero, unit = real(0.0), real(FIXED_POINT)
    impulse_unit = real(IMPULSE_UNIT)
    base = BASE_NODE

    @wp.kernel(enable_backward=False, module="unique")
    def step_nodes(batch: batch_struct(real), table: table_type):
        env, n = wp.tid()
        if batch.active[env] == 0:
            return
        nodes = batch.nodes
        sums = batch.sums
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
        slot = batch.step[env] % batch.history.shape[1]
        if mass + below > zero:
            v = momentum / (mass + below)
            pushed = vec3()
            if wp.static(bonded) and k <= base:
                v = vec3()
            else:
                i = n // (nodes[1] * nodes[2]) - batch.corner[0]
                j = (n // nodes[2]) % nodes[1] - batch.corner[1]
                place = vec3(real(i), real(j), real(k - batch.corner[2]))
                lever = place - batch.origin - batch.tip[env]
                answer = distance(table, env, lever)
                if answer[3] < batch.reach:
                    relative = v - batch.tip_velocity[env]
                    change = vec3()
                    if wp.static(published):
                        change = -relative
                    else:
                        normal = vec3(answer[0], answer[1], answer[2])
                        approach = wp.dot(relative, normal)
                        if approach < zero:
                            change = -normal * approach
                            if wp.static(friction):
                                slip = relative - normal * approach
                                size = wp.length(slip)
                                most = -batch.coefficient[env] * approach
                                if size <= most:
                                    change -= slip
                                else:
                                    change -= slip * (most / size)
                    v += change
                    pushed = change * (mass + below)
                    turned = wp.cross(lever, pushed)
                    for c in range(3):
                        wp.atomic_add(
                            batch.history, env, slot, c, wp.int64(pushed[c] * impulse_unit)
                        )
                        wp.atomic_add(
                            batch.history, env, slot, 3 + c, wp.int64(turned[c] * impulse_unit)
                        )
            if wp.static(bonded) and k <= base + 1:
                held = v * (mass - below) - before - pushed
                for c in range(3):
                    wp.atomic_add(batch.history, env, slot, 6 + c, wp.int64(held[c] * impulse_unit))
        batch.velocity[env, n] = v
        if wp.static(bonded) and k == base + 1:
            batch.velocity[env, n - 2] = -v

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
    def begin_step(batch: batch_struct(real)):
        env = wp.tid()
        at, corners = batch.at, batch.corners
        last = at.shape[1] - 1
        now = batch.step[env] + 1
        if batch.status[env] != 0 or now > at[env, last]:
            batch.active[env] = 0
            return
        batch.active[env] = 1
        batch.step[env] = now
        if now <= at[env, 0]:
            batch.tip[env] = corners[env, 0]
            batch.tip_velocity[env] = vec3()
            return
        segment = wp.int32(0)
        while segment < last - 1 and now > at[env, segment + 1]:
            segment += 1
        travel = corners[env, segment + 1] - corners[env, segment]
        steps = real(at[env, segment + 1] - at[env, segment])
        left = real(at[env, segment + 1] - now)
        batch.tip[env] = corners[env, segment + 1] - travel * (left / steps)
        batch.tip_velocity[env] = travel / steps

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
    def move(batch: batch_struct(real)):
        env, p = wp.tid()
        if batch.active[env] == 0:
            return
        nodes = batch.nodes
        u = batch.shift[env, p]
        x = batch.rest[p] + u
        first, offset = first_node(x)
        first += batch.corner
        w = weights(offset)
        arm = arms(offset)
        v = vec3()
        affine = mat33()
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    fraction = batch.velocity[env, row + k] * (w[0, i] * w[1, j] * w[2, k])
                    v += fraction
                    affine += wp.outer(fraction, vec3(arm[0, i], arm[1, j], arm[2, k]))
        affine = affine * moment
        if p < batch.held:
            v = vec3()
        u += v
        h = batch.gradient[env, p]
        h += affine + affine * h
        batch.shift[env, p] = u
        batch.gradient[env, p] = h

        # Written so that a NaN fails every check.
        if not (wp.length_sq(v) < real(SPEED_LIMIT * SPEED_LIMIT)):
            wp.atomic_max(batch.status, env, TOO_FAST)
            return
        if not (one + dilatation(h) > batch.det_floor):
            wp.atomic_max(batch.status, env, COLLAPSED)
            return
        x = batch.rest[p] + u
        first, offset = first_node(x)
        first += batch.corner
        for axis in range(3):
            if first[axis] < 0 or first[axis] + 2 >= nodes[axis]:
                wp.atomic_max(batch.status, env, LEFT_GRID)
                return

        w = weights(offset)
        arm = arms(offset)
        mass = batch.volume[p]
        push = affine * mass - kirchhoff(h, batch.shear[env], batch.bulk[env]) * (moment * mass)
        momentum = v * mass
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    weight = w[0, i] * w[1, j] * w[2, k] * unit
                    transfer = (momentum + push * vec3(arm[0, i], arm[1, j], arm[2, k])) * weight
                    wp.atomic_add(batch.sums, env, row + k, 0, wp.int64(mass * weight))
                    wp.atomic_add(batch.sums, env, row + k, 1, wp.int64(transfer[0]))
                    wp.atomic_add(batch.sums, env, row + k, 2, wp.int64(transfer[1]))
                    wp.atomic_add(batch.sums, env, row + k, 3, wp.int64(transfer[2]))

    return move


# Readings of the particles at a waypoint: surface, energy, and compression of the material.


@functools.cache
def reading_kernels(real):
    """Return the kernels of the surface's displacement and of sums over the body."""
    vec3 = vector_of(real)
    first_node, weights, _arms = spline_functions(real)
    dilatation, _kirchhoff, energy = law_functions(real)
    one, half, unit = real(1.0), real(0.5), real(FIXED_POINT)

    @wp.kernel(enable_backward=False, module="unique")
    def surface(batch: batch_struct(real)):
        env, n = wp.tid()
        p = batch.rest.shape[0] - batch.to_surface.shape[0] + n
        bent = batch.gradient[env, p] * batch.to_surface[n]
        batch.surface[env, n] = batch.shift[env, p] + bent

    @wp.kernel(enable_backward=False, module="unique")
    def body(batch: batch_struct(real), whole: real):
        env, p = wp.tid()
        if batch.status[env] != 0:
            return
        nodes = batch.nodes
        h = batch.gradient[env, p]
        first, offset = first_node(batch.rest[p] + batch.shift[env, p])
        first += batch.corner
        w = weights(offset)
        v = vec3()
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    v += batch.velocity[env, row + k] * (w[0, i] * w[1, j] * w[2, k])
        fraction = batch.volume[p] / whole * unit
        stored = energy(h, batch.shear[env], batch.bulk[env]) * fraction
        wp.atomic_add(batch.means, env, 0, wp.int64(stored))
        wp.atomic_add(batch.means, env, 1, wp.int64(half * wp.length_sq(v) * fraction))
        wp.atomic_min(batch.det, env, one + dilatation(h))

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
        lattice: ParticleLattice,
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
        batch = self.batch = batch_struct(real)()
        """Everything on the device."""
        batch.nodes, batch.corner = wp.vec3i(*lattice.nodes), wp.vec3i(*lattice.corner)
        batch.origin, batch.held = vec3(*lattice.origin), lattice.held
        batch.reach = real(REACH if numerics.published is None else 0.0)
        batch.det_floor = real(DET_FLOOR)
        batch.rest = self.array(lattice.rest, vec3)
        batch.volume = self.array(lattice.volume, real)
        batch.to_surface = self.array(lattice.to_surface, vec3)
        self._fill_environments(scenes, numerics)
        self._fill_schedules(paces)
        for shape, dtype, names in (
            (count, wp.int32, ("status", "step")),
            (count, vec3, ("tip", "tip_velocity")),
            ((count, particles), vec3, ("shift",)),
            ((count, particles), matrix_of(real), ("gradient",)),
            ((count, nodes), vec3, ("velocity",)),
            ((count, nodes, 4), wp.int64, ("sums",)),
            ((count, ROUND, READINGS), wp.int64, ("history",)),
            ((count, len(lattice.to_surface)), vec3, ("surface",)),
            ((count, 2), wp.int64, ("means",)),
            (count, real, ("det",)),
        ):
            for name in names:
                setattr(batch, name, wp.zeros(shape, dtype=dtype, device=self.device))
        batch.active = wp.full(count, 1, dtype=wp.int32, device=self.device)
        self._graph = None
        # Initial sums of the grid: a time step of particles at rest changes nothing else.
        self.move_particles()

    def _fill_environments(self, scenes, numerics) -> None:
        real, units, batch = self.real, self.units, self.batch
        stress = np.array([unit.stress for unit in units])
        batch.shear = self.array([one.body.shear_modulus for one in scenes] / stress, real)
        batch.bulk = self.array([one.body.bulk_modulus for one in scenes] / stress, real)
        indenters = [one.indenter for one in scenes]
        cell = self.lattice.cell
        self._table = PartTable.pack(indenters, cell, real, self.device, far=FAR * cell)
        friction = [one.effects.friction for one in scenes]
        coefficients = [0.0 if one is None else one.coefficient for one in friction]
        batch.coefficient = self.array(coefficients, real)
        self._node_kernel = node_kernel(
            real, numerics.published is not None, friction[0] is not None, self._table.traits
        )

    def _fill_schedules(self, paces: Sequence[Pace]) -> None:
        """Set corners and steps of every environment, padded with their last to the longest."""
        longest = max(len(pace.at) for pace in paces)
        corners = np.stack(
            [np.pad(pace.corners, ((0, longest - len(pace.at)), (0, 0)), "edge") for pace in paces]
        )
        at = np.stack([np.pad(pace.at, (0, longest - len(pace.at)), "edge") for pace in paces])
        self.batch.corners = self.array(corners / self.lattice.cell, self.vec3)
        self.batch.at = self.array(at, wp.int32)

    def array(self, values, dtype) -> wp.array:
        """Return values as an array on the device."""
        plain = np.int32 if dtype is wp.int32 else numpy_of(self.real)
        return wp.array(np.asarray(values, plain), dtype=dtype, device=self.device)

    @property
    def bytes(self) -> int:
        """Memory of all arrays [bytes]."""
        values = [getattr(self.batch, name) for name in batch_struct(self.real).vars]
        return sum(value.capacity for value in values if isinstance(value, wp.array))

    def advance(self, steps: int) -> np.ndarray:
        """Take up to `ROUND` steps; return readings (steps, B, 9) [cells, steps], 0 if ended."""
        self.batch.history.zero_()
        before = int(self.batch.step.numpy().max())
        if steps == ROUND and self.device.is_cuda:
            self._replay()
        else:
            for _ in range(steps):
                self._one_step()
        slots = (before + 1 + np.arange(steps)) % ROUND
        return np.moveaxis(self.batch.history.numpy()[:, slots], 0, 1) / IMPULSE_UNIT

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

    def _launch(self, kernel, each: tuple[int, ...], *inputs) -> None:
        dim = (len(self.units), *each)
        wp.launch(kernel, dim, [self.batch, *inputs], device=self.device)

    def begin_step(self) -> None:
        """Advance the tips and determine which environments take a step."""
        self._launch(tip_kernel(self.real), ())

    def step_nodes(self) -> None:
        """Compute velocities of the nodes from mass and momentum of the particles."""
        self._launch(self._node_kernel, (self.lattice.node_count,), self._table.struct)

    def move_particles(self) -> None:
        """Displace and deform the particles, and transfer their mass and momentum to the nodes."""
        self._launch(particle_kernel(self.real), (len(self.lattice.rest),))

    def surface(self) -> np.ndarray:
        """Return displacements of the top of all environments (environments, X, Y, 3) [cells]."""
        self._launch(reading_kernels(self.real)[0], (len(self.lattice.to_surface),))
        nx, ny, _nz = self.lattice.counts
        return self.batch.surface.numpy().reshape(len(self.units), nx, ny, 3).astype(float)

    def means(self) -> list[Means]:
        """Return energies and smallest determinant of every environment."""
        whole = self.real(self.lattice.volume.sum())
        self.batch.means.zero_()
        self.batch.det.fill_(float("inf"))
        self._launch(reading_kernels(self.real)[1], (len(self.lattice.rest),), whole)
        means = self.batch.means.numpy() / FIXED_POINT
        det = self.batch.det.numpy().astype(float)
        return [
            Means(float(one[0]), float(one[1]), float(least))
            for one, least in zip(means, det, strict=True)
        ]
