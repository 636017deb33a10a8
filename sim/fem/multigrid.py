# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Preconditioner: vertical columns solved exactly, corrected on ever coarser grids in plan.

The nodes of a column form a block-tridiagonal system, factored as L D L^T with one 3x3 pivot per
node (Golub & Van Loan, Matrix Computations, 4th ed., section 4.5.1). The blocks are those of the
current state: with those of the undeformed body, columns need more iterations than single nodes.

Where the tangent is not convex, a pivot may have eigenvalues that are zero or negative. Those are
raised to their absolute values or more; L D L^T with positive pivots is positive definite for any
L.
"""

import functools
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.arrays import Array
from sim.device import kernel, loaded_together
from sim.fem.arrays import array_of
from sim.fem.matrix import CENTRE, SLOTS, row_function, slot_offsets, zero_blocks
from sim.fem.mesh import Mesh
from sim.scalars import matrix_of, vector_of

# Columns per block of GPU threads, which adds up their sums.
BLOCK = 64
# Least eigenvalue of a pivot over the mean diagonal of its block. The ratio of shear to bulk
# modulus at nu = 0.4999 makes it 1e-4; below 1e-6 float32 has no digits left.
PIVOT_LEAST = 1e-5


@functools.cache
def factors_struct(real):
    """Return the struct of a grid's factors (B, columns, Z)."""
    mat33 = matrix_of(real)

    class DeviceFactors:
        pivot: wp.array3d(dtype=mat33)  # inverse pivots
        upper: wp.array3d(dtype=mat33)  # each times the coupling to the node above

    return wp.struct(DeviceFactors)


@functools.cache
def _factor_kernel(real):
    mat33 = matrix_of(real)
    half, third, least = real(0.5), real(1.0 / 3.0), real(PIVOT_LEAST)

    @wp.func
    def positive(a: mat33):
        """True if a symmetric matrix is positive definite, by its leading minors."""
        return (
            a[0, 0] > real(0.0)
            and a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0] > real(0.0)
            and wp.determinant(a) > real(0.0)
        )

    @wp.func
    def clamped_eigenvalues(a: mat33, floor: real):
        """Return the symmetric matrix with eigenvalues raised to max(absolute value, `floor`)."""
        vectors, values = wp.eig3(a)
        for i in range(3):
            values[i] = wp.max(wp.abs(values[i]), floor)
        return vectors * wp.diag(values) * wp.transpose(vectors)

    @kernel()
    def factor(
        # Mesh:
        free: wp.array(dtype=wp.int32),
        # In:
        active: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=mat33),
        # Out:
        factors: factors_struct(real),
    ):
        env, column = wp.tid()
        if active[env] == 0:
            return
        below = mat33()
        levels = factors.pivot.shape[2]
        for k in range(levels):
            n = column * levels + k
            inverse = mat33()
            upper = mat33()
            block = matrix[env, n, CENTRE]
            size = wp.abs(block[0, 0]) + wp.abs(block[1, 1]) + wp.abs(block[2, 2])
            # Nodes outside a round body have no stiffness and do not move.
            if free[n] == 1 and size > real(0.0):
                floor = least * third * size
                pivot = block - below
                pivot = (pivot + wp.transpose(pivot)) * half
                if not positive(pivot - wp.identity(n=3, dtype=real) * floor):
                    pivot = clamped_eigenvalues(pivot, floor)
                inverse = wp.inverse(pivot)
                coupling = matrix[env, n, CENTRE + 1]
                upper = inverse * coupling
                below = wp.transpose(coupling) * upper
            factors.pivot[env, column, k] = inverse
            factors.upper[env, column, k] = upper

    return factor


@functools.cache
def _column_kernels(real, on_gpu: bool):
    """Return the kernels (step, sweep); on a CPU the second takes the step as well."""
    vec3 = vector_of(real)
    factors_type = factors_struct(real)
    lanes = BLOCK if on_gpu else 1

    @wp.func
    def stepped(
        env: int,
        n: int,
        scalars: wp.array2d(dtype=wp.float64),
        p: wp.array2d(dtype=vec3),
        product: wp.array2d(dtype=vec3),
        solution_out: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec3),
    ):
        length = real(scalars[env, 2])
        solution_out[env, n] = solution_out[env, n] + p[env, n] * length
        r_out[env, n] = r_out[env, n] - product[env, n] * length

    @kernel(block=BLOCK)
    def sweep(
        factors: factors_type,
        # As in `step`
        which: wp.array(dtype=wp.int32),
        scalars: wp.array2d(dtype=wp.float64),
        p: wp.array2d(dtype=vec3),
        product: wp.array2d(dtype=vec3),
        solution_out: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec3),
        # Out: preconditioned residual, and partial sums of r.z and r.r
        z_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        row, column = wp.tid()
        env = which[row]
        if env < 0:
            return
        rz = wp.float64(0.0)
        rr = wp.float64(0.0)
        if column < factors.pivot.shape[1]:
            levels = factors.pivot.shape[2]
            coupled = vec3()
            for k in range(levels):
                n = column * levels + k
                if wp.static(not on_gpu):
                    stepped(env, n, scalars, p, product, solution_out, r_out)
                y = r_out[env, n] - coupled  # the solution by L
                z_out[env, n] = y
                coupled = wp.transpose(factors.upper[env, column, k]) * y
            z = vec3()
            for j in range(levels):
                k = levels - 1 - j
                n = column * levels + k
                z = factors.pivot[env, column, k] * z_out[env, n] - (
                    factors.upper[env, column, k] * z
                )
                z_out[env, n] = z
                rz += wp.float64(wp.dot(r_out[env, n], z))
                rr += wp.float64(wp.dot(r_out[env, n], r_out[env, n]))
        if wp.static(on_gpu):
            rz = wp.tile_sum(wp.tile(rz))[0]
            rr = wp.tile_sum(wp.tile(rr))[0]
        if column % lanes == 0:
            sums_out[env, column // lanes, 0] = rz
            sums_out[env, column // lanes, 1] = rr

    if not on_gpu:
        return None, sweep

    @kernel()
    def step(
        # In: step length (B, 2); search direction and the tangent times it
        which: wp.array(dtype=wp.int32),
        scalars: wp.array2d(dtype=wp.float64),
        p: wp.array2d(dtype=vec3),
        product: wp.array2d(dtype=vec3),
        # In and out:
        solution_out: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec3),
    ):
        """Step each node's solution and residual before `sweep`, with coalesced memory access."""
        row, n = wp.tid()
        env = which[row]
        if env >= 0:
            stepped(env, n, scalars, p, product, solution_out, r_out)

    return step, sweep


class Factors:
    """Factors of the columns of B environments on one grid, `levels` high; `free` (N,) move."""

    def __init__(
        self, free, levels: int, real, environments: int, device: str, *, parallel: bool
    ) -> None:
        self._environments, self._device = environments, device
        self._kernel = _factor_kernel(real)
        self.columns = len(free) // levels
        """Number of columns."""
        shape = (levels, self.columns) if parallel else (self.columns, levels)
        stored = wp.zeros((2, environments, *shape), matrix_of(real), device=device)
        stored = stored.transpose((0, 1, 3, 2)) if parallel else stored
        self.arrays = factors_struct(real)()
        """The factors on the device."""
        self.arrays.pivot, self.arrays.upper = stored[0], stored[1]
        self._free = wp.array(free.astype(np.int32), dtype=wp.int32, device=device)

    def make(self, active, matrix) -> None:
        """Factor the columns of active environments, from the blocks (B, N, 27) of the tangent."""
        columns, inputs = (self._environments, self.columns), [self._free, active, matrix]
        wp.launch(self._kernel, columns, inputs, [self.arrays], device=self._device)


# Multigrid: columns on the mesh, corrected on ever coarser grids in plan.
#
# Columns leave the couplings between them to the conjugate gradients. These couplings are strong
# where elements are narrower than high, as under a small contact on a thick body, and in nearly
# incompressible bodies, where pressure on a column is passed to its neighbours. There columns alone
# take hundreds of iterations. With coarser grids they take 5 to 30, for a Poisson's ratio of 0.4999
# up to 100, each about six times as long.
#
# One application is a symmetric V-cycle (Briggs, Henson & McCormick, A Multigrid Tutorial, 2nd ed.,
# 2000). On each grid the columns are solved once before and once after the correction by the next
# coarser one. Coarser grids keep all nodes of a column, and leave out lines of nodes along x and y
# where these are closest together: so each grid is more even than the one before, and the strong
# couplings of a graded mesh are those that it coarsens. The tangent on a coarser grid is that of
# the finer one for displacements interpolated from it (Galerkin's). It is made again when solves
# slow down. From a spacing of a thickness on, columns alone do well.
#
# A fraction of the columns' solutions is added up. An element joins four columns, so if no element
# has negative stiffness, the tangent is at most four times its part within columns; with a fraction
# below one half the cycle is therefore positive definite.

# Iterations of one solve with columns alone from which an environment gets coarser grids. On a GPU,
# where a cycle is many small kernels, it takes longer beside an iteration of columns alone.
HARD_FROM = {"cpu": 60, "cuda": 150}
# Fraction of the columns' solutions that is added up, at most one half.
SMOOTHING = 0.4
# Largest fraction of the nodes that a coarser grid keeps, and growth of the spacing that is tried.
FRACTION_MOST, SPACING_GROWTH = 0.5, 1.2
# Spacing in plan, in thicknesses, at which coarsening ends.
COARSEST_SPACING = 1.0
# Coarser grids are kept until a solve takes this many times the iterations per digit of the first
# with them, and `SLOWER_BY` more: making them costs as much as several iterations.
SLOWER, SLOWER_BY = 1.4, 2.0


def coarsened(x: Array, spacing: float) -> int:
    """Return the number of points of `x` (X,) to keep, from its start, `spacing` apart or more."""
    count, last = 2, x[0]
    for here, after in pairwise(x[1:]):
        if after - last > spacing * (1 + 1e-4):
            count, last = count + 1, here
    return count


def thinned(x: Array, count: int) -> NDArray[np.int64]:
    """Return the indices (..., `count`) of points of axes `x` (..., X) with their ends.

    Each point that is left out is the one between the two closest neighbours.
    """
    points = np.broadcast_to(np.arange(x.shape[-1]), x.shape)
    while points.shape[-1] > count:
        at = np.take_along_axis(x, points, axis=-1)
        out = 1 + np.argmin(at[..., 2:] - at[..., :-2], axis=-1)
        stay = np.arange(points.shape[-1]) != out[..., None]
        points = points[stay].reshape(*x.shape[:-1], -1)
    return points


def grid_counts(x: Array, y: Array) -> list[tuple[int, int]]:
    """Return the numbers of nodes of each grid coarser than that at x (X,) and y (Y,)."""
    grids: list[tuple[int, int]] = []
    spacing = min(np.diff(x).min(), np.diff(y).min())
    while spacing < COARSEST_SPACING:
        spacing *= SPACING_GROWTH
        counts = coarsened(x, spacing), coarsened(y, spacing)
        fraction = counts[0] * counts[1] / (len(x) * len(y))
        if fraction > FRACTION_MOST and (spacing < COARSEST_SPACING or fraction > 0.9):
            continue
        grids.append(counts)
        x, y = x[thinned(x, counts[0])], y[thinned(y, counts[1])]
    return grids


@functools.cache
def _interpolation_structs(real):
    """Return the structs of linear interpolation to a finer grid, for M meshes: axis, both."""

    class Axis:
        below: wp.array2d(dtype=wp.int32)  # coarse line of nodes below (or at) each (M, fine)
        part: wp.array2d(dtype=real)  # weight of the line after it (M, fine)
        reach: wp.array3d(dtype=wp.int32)  # range of fine lines by coarse line (M, coarse, 2)

    axis = wp.struct(Axis)

    class Interpolation:
        variant: wp.array(dtype=wp.int32)  # mesh of each environment (B,)
        levels: int  # nodes of a column
        x: axis
        y: axis

    return axis, wp.struct(Interpolation)


@functools.cache
def _kernels(real, parallel: bool):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    axis_type, weights_type = _interpolation_structs(real)
    line = row_function(real, real, not parallel)
    omega = real(SMOOTHING)
    batched = kernel(group=f"sim.fem.multigrid.{real.__name__}.{parallel}")

    @wp.func
    def hard_environment(which: wp.array(dtype=wp.int32), hard: wp.array(dtype=wp.int32), row: int):
        """Return the environment of a row; -1 if there is none, or it is not hard."""
        env = which[row]
        if env >= 0:
            if hard[env] == 0:
                env = -1
        return env

    @batched
    def scale(
        # In:
        which: wp.array(dtype=wp.int32),
        hard: wp.array(dtype=wp.int32),
        parts: int,
        # In and out: solution of the columns, and its partial sums of r.z, which are cleared
        z_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        row, n = wp.tid()
        env = hard_environment(which, hard, row)
        if env < 0:
            return
        z_out[env, n] = z_out[env, n] * omega
        if n < parts:
            sums_out[env, n, 0] = wp.float64(0.0)

    @batched
    def smooth(
        # In: environments; factors; right-hand side; 1 to add to z
        which: wp.array(dtype=wp.int32),
        hard: wp.array(dtype=wp.int32),
        factors: factors_struct(real),
        rhs: wp.array2d(dtype=vec3),
        add: int,
        # In: residual whose partial sums of r.z are written, and the first of them; below 0: none
        r: wp.array2d(dtype=vec3),
        first: int,
        # Out: half-way solution, which may be `rhs`
        y_out: wp.array2d(dtype=vec3),
        # In and out:
        z_out: wp.array2d(dtype=vec3),
        # Out:
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        """Set z to a fraction of the columns' solution, or add it to z."""
        row, column = wp.tid()
        env = hard_environment(which, hard, row)
        if env < 0:
            return
        levels = factors.pivot.shape[2]
        coupled = vec3()
        for k in range(levels):
            n = column * levels + k
            y = rhs[env, n] - coupled
            y_out[env, n] = y
            coupled = wp.transpose(factors.upper[env, column, k]) * y
        rz = wp.float64(0.0)
        z = vec3()
        for j in range(levels):
            k = levels - 1 - j
            n = column * levels + k
            z = factors.pivot[env, column, k] * y_out[env, n] - factors.upper[env, column, k] * z
            total = z * omega
            if add == 1:
                total += z_out[env, n]
            # Nodes outside a round body, which coarser grids may reach, do not move.
            if factors.pivot[env, column, k][0, 0] == real(0.0):
                total = vec3()
            z_out[env, n] = total
            if first >= 0:
                rz += wp.float64(wp.dot(r[env, n], total))
        if first >= 0:
            sums_out[env, first + column, 0] = rz

    @batched
    def residual(
        # In:
        which: wp.array(dtype=wp.int32),
        hard: wp.array(dtype=wp.int32),
        offsets: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=mat33),
        rhs: wp.array2d(dtype=vec3),
        z: wp.array2d(dtype=vec3),
        # Out:
        rest_out: wp.array2d(dtype=vec3),
    ):
        row, n = wp.tid()
        env = hard_environment(which, hard, row)
        if env < 0:
            return
        rest_out[env, n] = rhs[env, n] - line(offsets, matrix, z, env, n)

    @wp.func
    def weight(axis: axis_type, mesh: int, fine: int, coarse: int):
        """Return the weight of a coarse line of nodes at a fine one (linear interpolation)."""
        fraction = real(0.0)
        if axis.below[mesh, fine] == coarse:
            fraction = real(1.0) - axis.part[mesh, fine]
        elif axis.below[mesh, fine] + 1 == coarse:
            fraction = axis.part[mesh, fine]
        return fraction

    @batched
    def restrict(
        which: wp.array(dtype=wp.int32),
        hard: wp.array(dtype=wp.int32),
        weights: weights_type,
        # In:
        fine: wp.array2d(dtype=vec3),
        # Out:
        coarse_out: wp.array2d(dtype=vec3),
    ):
        """Add up the residuals of the finer grid that each coarser node moves."""
        row, n = wp.tid()
        env = hard_environment(which, hard, row)
        if env < 0:
            return
        mesh = weights.variant[env]
        levels = weights.levels
        wide = weights.y.reach.shape[1]
        i = n // (wide * levels)
        j = (n // levels) % wide
        k = n % levels
        total = vec3()
        for a in range(weights.x.reach[mesh, i, 0], weights.x.reach[mesh, i, 1]):
            along_x = weight(weights.x, mesh, a, i)
            for b in range(weights.y.reach[mesh, j, 0], weights.y.reach[mesh, j, 1]):
                along = along_x * weight(weights.y, mesh, b, j)
                total += fine[env, (a * weights.y.below.shape[1] + b) * levels + k] * along
        coarse_out[env, n] = total

    @batched
    def prolong(
        which: wp.array(dtype=wp.int32),
        hard: wp.array(dtype=wp.int32),
        weights: weights_type,
        # In:
        coarse: wp.array2d(dtype=vec3),
        # In and out:
        fine_out: wp.array2d(dtype=vec3),
    ):
        """Add the displacements of the coarser grid to those of the finer one."""
        row, n = wp.tid()
        env = hard_environment(which, hard, row)
        if env < 0:
            return
        mesh = weights.variant[env]
        levels = weights.levels
        wide = weights.y.below.shape[1]
        a = n // (wide * levels)
        b = (n // levels) % wide
        k = n % levels
        coarse_y = weights.y.reach.shape[1]
        x = weights.x.part[mesh, a]
        y = weights.y.part[mesh, b]
        first = (weights.x.below[mesh, a] * coarse_y + weights.y.below[mesh, b]) * levels + k
        near = coarse[env, first] * (real(1.0) - y) + coarse[env, first + levels] * y
        first += coarse_y * levels
        far = coarse[env, first] * (real(1.0) - y) + coarse[env, first + levels] * y
        fine_out[env, n] = fine_out[env, n] + near * (real(1.0) - x) + far * x

    @batched
    def coarsen(
        weights: weights_type,
        # In:
        active: wp.array(dtype=wp.int32),
        fine: wp.array3d(dtype=mat33),
        # Out:
        coarse_out: wp.array3d(dtype=mat33),
    ):
        """Make the tangent of the coarser grid: interpolation^T tangent interpolation."""
        env = int(0)
        n = int(0)
        slot = int(0)
        if wp.static(parallel):
            env, slot, n = wp.tid()
        else:
            env, n, slot = wp.tid()
        if active[env] == 0:
            return
        mesh = weights.variant[env]
        levels = weights.levels
        wide = weights.y.reach.shape[1]
        fine_x = weights.x.below.shape[1]
        fine_y = weights.y.below.shape[1]
        i = n // (wide * levels)
        j = (n // levels) % wide
        k = n % levels
        i2 = i + slot // 9 - 1
        j2 = j + (slot // 3) % 3 - 1
        total = mat33()
        if i2 >= 0 and i2 < weights.x.reach.shape[1] and j2 >= 0 and j2 < wide:
            for a in range(weights.x.reach[mesh, i, 0], weights.x.reach[mesh, i, 1]):
                x = weight(weights.x, mesh, a, i)
                for da in range(3):
                    a2 = a + da - 1
                    along_x = real(0.0)
                    if a2 >= 0 and a2 < fine_x:
                        along_x = x * weight(weights.x, mesh, a2, i2)
                    if along_x != real(0.0):
                        for b in range(weights.y.reach[mesh, j, 0], weights.y.reach[mesh, j, 1]):
                            y = along_x * weight(weights.y, mesh, b, j)
                            for db in range(3):
                                b2 = b + db - 1
                                along = real(0.0)
                                if b2 >= 0 and b2 < fine_y:
                                    along = y * weight(weights.y, mesh, b2, j2)
                                if along != real(0.0):
                                    m = (a * fine_y + b) * levels + k
                                    total += fine[env, m, 9 * da + 3 * db + slot % 3] * along
        coarse_out[env, n, slot] = total

    return scale, smooth, residual, restrict, prolong, coarsen


@dataclass(slots=True)
class _Grid:
    """A grid with its tangent, and its vectors (B, N) in a cycle."""

    counts: tuple[int, int, int]
    """Nodes along x, y, z."""
    offsets: wp.array
    factors: Factors
    matrix: wp.array | None
    """Blocks (B, N, 27); the finest grid's are given with each factorisation."""
    rhs: wp.array | None
    z: wp.array | None
    """Right-hand side and solution; the finest grid's are those of the conjugate gradients."""
    rest: wp.array
    """Residual of `z`."""
    weights: object | None
    """Interpolation to the next finer grid."""


def _weights(fine: Array, points: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Return `below`, `part` and `reach` of an interpolation to the points of M meshes (M, X)."""
    below, part, reach = [], [], []
    for x, chosen in zip(fine, points, strict=True):
        coarse = x[chosen]
        first = np.clip(np.searchsorted(coarse, x, side="right") - 1, 0, len(coarse) - 2)
        below.append(first)
        part.append((x - coarse[first]) / (coarse[first + 1] - coarse[first]))
        ends = [chosen[0] - 1, *chosen, chosen[-1] + 1]
        reach.append(np.stack([np.add(ends[:-2], 1), ends[2:]], axis=1))
    return np.array(below), np.array(part), np.array(reach)


class Multigrid:
    """Columns of B environments, with coarser grids for hard ones; it owns their factors.

    Those of the columns take 72 bytes per node and environment in float32. Meshes have the same
    numbers of nodes; `variant` is the index of that of each environment (B,). If `parallel`, by
    default only on a GPU, matrices and factors have node and column numbers running fastest.
    """

    def __init__(
        self,
        meshes: list[Mesh],
        variant: NDArray[np.int64],
        real,
        device: str,
        *,
        parallel: bool | None = None,
    ) -> None:
        on_gpu = wp.get_device(device).is_cuda
        self._parallel = on_gpu if parallel is None else parallel
        self._meshes, self._real, self._device = meshes, real, device
        environments = self._environments = len(variant)
        self._on_gpu = on_gpu
        self._step, self._sweep = _column_kernels(real, on_gpu)
        levels = meshes[0].cells[2] + 1
        self._factors = self._factors_of(meshes[0].free, levels)
        columns = self._factors.columns
        self._column_parts = -(-columns // BLOCK) if on_gpu else columns
        self._hard_from = HARD_FROM["cuda" if on_gpu else "cpu"]
        self.parts = self._column_parts + columns
        """Number of partial sums that `advance` writes for each sum."""
        self.hard = np.zeros(environments, bool)
        """True for environments that use coarser grids (B,)."""
        self._hard = wp.zeros(environments, dtype=wp.int32, device=device)
        # Coarser grids to be made again; iterations per digit with those that there are.
        self._due, self._rate = np.zeros(environments, bool), np.full(environments, np.nan)
        self._variant = wp.array(np.asarray(variant, np.int32), dtype=wp.int32, device=device)
        self._grids: list[_Grid] = []
        self.grids = 1
        """Number of grids that `advance` uses."""

    def _factors_of(self, free, levels: int) -> Factors:
        of = self._real, self._environments, self._device
        return Factors(free, levels, *of, parallel=self._parallel)

    def choose(self, running: NDArray[np.int64]) -> int:
        """Set and return `grids`: 1 if none of the running environments (R,) is hard."""
        self.grids = len(self._grids) if self.hard[running].any() else 1
        return self.grids

    def learn(self, used: NDArray[np.int64], accuracy: Array) -> None:
        """Decide from the last solves which environments need coarser grids, or new ones.

        They took iterations (B,), 0 if there was none, to a residual over that at the start (B,).
        """
        solved = used > 0
        rate = used / np.log10(1 / np.minimum(accuracy, 0.5))
        first = solved & np.isnan(self._rate)
        self._rate[first] = rate[first]
        self._due |= solved & self.hard & (rate > SLOWER * self._rate + SLOWER_BY)
        hard = self.hard | (used >= self._hard_from)
        if (hard == self.hard).all():
            return
        self._due |= hard & ~self.hard
        self.hard = hard
        self._hard.assign(hard.astype(np.int32))
        if not self._grids:
            with loaded_together(self._device):
                self._kernels = _kernels(self._real, self._parallel)
            self._make_grids()

    def _make_grids(self) -> None:
        x, y = (np.array([getattr(one, axis) for one in self._meshes]) for axis in "xy")
        levels = self._meshes[0].cells[2] + 1
        self._grids = [self._grid((len(x[0]), len(y[0]), levels))]
        for many, wide in grid_counts(x[0], y[0]):
            points_x, points_y = thinned(x, many), thinned(y, wide)
            axis, both = _interpolation_structs(self._real)
            weights = both()
            weights.variant, weights.levels = self._variant, levels
            for name, of in (("x", _weights(x, points_x)), ("y", _weights(y, points_y))):
                along = axis()
                along.below, along.part, along.reach = map(self._array, of)
                setattr(weights, name, along)
            self._grids.append(self._grid((many, wide, levels), weights))
            x, y = (np.take_along_axis(*one, axis=1) for one in ((x, points_x), (y, points_y)))

    def _grid(self, counts: tuple[int, int, int], weights=None) -> _Grid:
        """Return a coarser grid with its interpolation, or the finest one."""
        real, device, environments = self._real, self._device, self._environments
        nodes = counts[0] * counts[1] * counts[2]

        def vector() -> wp.array:
            return wp.zeros((environments, nodes), vector_of(real), device=device)

        cells = counts[0] - 1, counts[1] - 1, counts[2] - 1
        offsets = self._array(slot_offsets(cells))
        if weights is None:
            return _Grid(counts, offsets, self._factors, None, None, None, vector(), None)
        free = np.ones(nodes, bool)
        factors = self._factors_of(free, counts[2])
        matrix = zero_blocks(environments, nodes, matrix_of(real), device, parallel=self._parallel)
        return _Grid(counts, offsets, factors, matrix, vector(), vector(), vector(), weights)

    def factor(self, active, matrix) -> None:
        """Factor the columns of the tangent, whose blocks (B, N, 27) are `matrix`."""
        self._factors.make(active, matrix)

    def factor_grids(self, active, matrix) -> None:
        """Make and factor the grids that hard environments need; `advance` reads the matrix too."""
        if not self._grids:
            return
        self._grids[0].matrix = matrix
        if not self._due.any():
            return
        due = active.numpy().astype(bool) & self._due
        if not due.any():
            return
        self._due[due], self._rate[due] = False, np.nan
        chosen = wp.array(due.astype(np.int32), dtype=wp.int32, device=self._device)
        *_others, coarsen = self._kernels
        for fine, coarse in pairwise(self._grids):
            nodes = coarse.rest.shape[1]
            room = (SLOTS, nodes) if self._parallel else (nodes, SLOTS)
            by_block = self._environments, *room
            inputs = [coarse.weights, chosen, fine.matrix]
            wp.launch(coarsen, by_block, inputs, [coarse.matrix], device=self._device)
            coarse.factors.make(chosen, coarse.matrix)

    def advance(self, which, scalars, along, vectors, sums) -> None:
        """Take a step of conjugate gradients, and precondition the new residual.

        `which` are indices of environments, int32 (R,), -1 none; the step's length is column 2 of
        `scalars` (B, 3 or more), float64. `along` are the search direction and the tangent times
        it, `vectors` solution and residual, which the step changes, and the preconditioned
        residual, each (B, N). `sums` gets the partial sums of r.z and r.r (B, `parts`, 2), float64.
        """
        solution, r, z = vectors
        inputs = [which, scalars, *along]
        if self._on_gpu:
            wp.launch(
                self._step, (len(which), r.shape[1]), inputs, [solution, r], device=self._device
            )
        by_column = len(which), self._column_parts * (BLOCK if self._on_gpu else 1)
        inputs, outputs = [self._factors.arrays, *inputs], [solution, r, z, sums]
        wp.launch(self._sweep, by_column, inputs, outputs, device=self._device, block_dim=BLOCK)
        if self.grids == 1:
            return
        scale, _smooth, residual, restrict, prolong, _coarsen = self._kernels
        finest, grids = self._grids[0], self._grids
        finest.rhs, finest.z = r, z
        nodes = finest.rest.shape[1]
        self._launch(scale, nodes, which, [self._column_parts], [finest.z, sums])
        for fine, coarse in pairwise(grids):
            rest = [fine.offsets, fine.matrix, fine.rhs, fine.z]
            self._launch(residual, fine.rest.shape[1], which, rest, [fine.rest])
            inputs = [coarse.weights, fine.rest]
            self._launch(restrict, coarse.rest.shape[1], which, inputs, [coarse.rhs])
            self._smooth(which, coarse, coarse.rhs, sums)
        for coarse, fine in pairwise(reversed(grids)):
            inputs = [coarse.weights, coarse.z]
            self._launch(prolong, fine.rest.shape[1], which, inputs, [fine.z])
            rest = [fine.offsets, fine.matrix, fine.rhs, fine.z]
            self._launch(residual, fine.rest.shape[1], which, rest, [fine.rest])
            self._smooth(which, fine, fine.rest, sums)

    def _smooth(self, which, grid: _Grid, rhs, sums) -> None:
        """Solve a grid's columns for `rhs`: its right-hand side at first, its residual later."""
        first = self._column_parts if grid is self._grids[0] else -1
        self._launch(
            self._kernels[1],
            grid.factors.columns,
            which,
            [grid.factors.arrays, rhs, int(rhs is grid.rest), grid.rhs, first],
            [grid.rest, grid.z, sums],
        )

    def _launch(self, kernel, count: int, which, inputs, outputs) -> None:
        inputs = [which, self._hard, *inputs]
        wp.launch(kernel, (len(which), count), inputs, outputs, device=self._device)

    def _array(self, values) -> wp.array:
        whole = np.issubdtype(np.asarray(values).dtype, np.integer)
        return array_of(values, wp.int32 if whole else self._real, self._real, self._device)
