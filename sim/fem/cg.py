# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Preconditioned conjugate gradients on all environments at once, each stopping independently.

The only data read back from the device are the indices of running environments, every `LOOK`
iterations. The iterations in between are one graph of five kernels each, recorded once per number
of launched rows, so Python need not launch every kernel. A row holds the index of an environment,
or -1. When half of the environments have finished, the others move together and half as many rows
are launched, since idle threads take time as well. Dot products are float64 whichever precision the
vectors have.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.mesh import CENTRE, Mesh
from sim.scalars import matrix_of, vector_of

# Iterations between checks for running environments: free on the CPU, a stop on a GPU.
LOOK = {"cpu": 1, "cuda": 8}

# Mark that replaces the target accuracy: stop here, the tangent is not convex.
CONCAVE = 1e300
# GPU threads that add up the partial sums of one environment.
LANES = 128
# Scalars per environment: r.z, target of r.r, step length, direction update (beta), slope.
SCALARS = 5


@functools.cache
def _cg_kernels(real, lanes: int):
    """Return the kernels for one precision; `lanes` threads add up a sum: 1, or a whole block."""
    vec3 = vector_of(real)

    @wp.func
    def total(sums: wp.array3d(dtype=wp.float64), env: int, lane: int, which: int):
        """Return a dot product from its partial sums."""
        whole = wp.float64(0.0)
        for part in range(lane, sums.shape[1], lanes):
            whole += sums[env, part, which]
        if wp.static(lanes > 1):
            whole = wp.tile_sum(wp.tile(whole))[0]
        return whole

    @wp.kernel(enable_backward=False, module="unique")
    def start(
        # In:
        which: wp.array(dtype=wp.int32),
        residual: wp.array2d(dtype=vec3),
        # Out:
        solution_out: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec3),
        p_out: wp.array2d(dtype=vec3),
        product_out: wp.array2d(dtype=vec3),
    ):
        row, n = wp.tid()
        env = which[row]
        if env < 0:
            return
        solution_out[env, n] = vec3()
        p_out[env, n] = vec3()
        product_out[env, n] = vec3()
        r_out[env, n] = residual[env, n]

    @wp.kernel(enable_backward=False, module="unique")
    def begin(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        accuracy: wp.array(dtype=wp.float64),
        # In and out:
        which: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
    ):
        row, lane = wp.tid()
        env = which[row]
        if env < 0:
            return
        rz = total(sums, env, lane, 0)
        rr = total(sums, env, lane, 1)
        if lane == 0:
            scalars_out[env, 0] = rz
            scalars_out[env, 1] = rr * accuracy[env] * accuracy[env]
            scalars_out[env, 3] = wp.float64(0.0)
            scalars_out[env, 4] = wp.float64(0.0)
            if rr == wp.float64(0.0):
                which[row] = -1

    @wp.kernel(enable_backward=False, module="unique")
    def step_length(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        # In and out:
        which: wp.array(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
    ):
        row, lane = wp.tid()
        env = which[row]
        if env < 0:
            return
        curvature = total(sums, env, lane, 0)
        if lane == 0:
            if curvature > wp.float64(0.0):
                scalars_out[env, 2] = scalars_out[env, 0] / curvature
            else:
                # Not convex along p: keep the solution so far; in the first iteration step along p.
                scalars_out[env, 2] = wp.float64(0.0)
                if count_out[env] == 0:
                    scalars_out[env, 2] = wp.float64(1.0)
                scalars_out[env, 1] = wp.float64(CONCAVE)
            # The right-hand side times p is r.z: all later residuals are orthogonal to it.
            scalars_out[env, 4] = scalars_out[env, 4] - scalars_out[env, 2] * scalars_out[env, 0]
            count_out[env] = count_out[env] + 1

    @wp.kernel(enable_backward=False, module="unique")
    def change(
        # In:
        sums: wp.array3d(dtype=wp.float64),
        # In and out:
        which: wp.array(dtype=wp.int32),
        scalars_out: wp.array2d(dtype=wp.float64),
    ):
        row, lane = wp.tid()
        env = which[row]
        if env < 0:
            return
        rz = total(sums, env, lane, 0)
        rr = total(sums, env, lane, 1)
        if lane == 0:
            scalars_out[env, 3] = rz / scalars_out[env, 0]
            scalars_out[env, 0] = rz
            if not (rr > scalars_out[env, 1]):
                which[row] = -1

    @wp.kernel(enable_backward=False, module="unique")
    def turn(
        # In:
        which: wp.array(dtype=wp.int32),
        scalars: wp.array2d(dtype=wp.float64),
        z: wp.array2d(dtype=vec3),
        # In and out:
        p_out: wp.array2d(dtype=vec3),
    ):
        row, n = wp.tid()
        env = which[row]
        if env < 0:
            return
        p_out[env, n] = z[env, n] + p_out[env, n] * real(scalars[env, 3])

    return start, begin, step_length, change, turn


class ConjugateGradient:
    """Solver of tangent x = residual for B environments of N nodes; it owns its vectors.

    Args:
        real: Warp's scalar type.
        environments: Number of environments, B.
        nodes: Number of nodes, N.
        device: Device of the vectors.
        matrix: Tangent: `product(which, p, product, sums)` writes tangent p and the partial sums
            of p . tangent p, (B, `matrix.parts`, 1), for the environments `which` (R,).
        preconditioner: `advance` steps along p and writes z and the partial sums of r.z and r.r,
            (B, `preconditioner.parts`, 2).
        gather: Launch fewer rows as environments end; by default only on a GPU.
        record: Record iterations as a graph; both may only launch kernels then.
    """

    def __init__(
        self,
        real,
        environments: int,
        nodes: int,
        device: str,
        matrix,
        preconditioner,
        *,
        gather: bool | None = None,
        record: bool = True,
    ) -> None:
        vec3 = vector_of(real)
        shape = (environments, nodes)
        self._real = real
        self._device = wp.get_device(device)
        self._matrix, self._preconditioner = matrix, preconditioner
        self._shape = shape
        self.solution = wp.zeros(shape, dtype=vec3, device=device)
        """Solution (B, N)."""
        self._r = wp.zeros(shape, dtype=vec3, device=device)
        self._p = wp.zeros(shape, dtype=vec3, device=device)
        self._z = wp.zeros(shape, dtype=vec3, device=device)
        self._product = wp.zeros(shape, dtype=vec3, device=device)
        parts = environments, matrix.parts, 1
        self._along = wp.zeros(parts, dtype=wp.float64, device=device)
        parts = environments, preconditioner.parts, 2
        self._sums = wp.zeros(parts, dtype=wp.float64, device=device)
        self._which = self._all_rows = wp.zeros(environments, dtype=wp.int32, device=device)
        self._count = wp.zeros(environments, dtype=wp.int32, device=device)
        self._accuracy = wp.zeros(environments, dtype=wp.float64, device=device)
        self._scalars = wp.zeros((environments, SCALARS), dtype=wp.float64, device=device)
        self._records, self._graphs = record, {}
        self._gathers = self._device.is_cuda if gather is None else gather
        self._lanes = LANES if self._device.is_cuda else 1

    def solve(self, active, residual, accuracy, most: int) -> np.ndarray:
        """Fill `solution` of active environments and return their numbers of iterations (B,).

        Args:
            active: Mask of environments, int32 (B,); not changed.
            residual: Right-hand side (B, N).
            accuracy: Target of |r| / |residual|, float64 NumPy (B,).
            most: Most iterations; the graph in which this is reached is completed.
        """
        start, begin, _step_length, _change, turn = _cg_kernels(self._real, self._lanes)
        self._gather(np.flatnonzero(active.numpy()), renew=True)
        self._accuracy.assign(accuracy)
        self._count.zero_()
        self._scalars.zero_()
        self._launch(start, [residual], [self.solution, self._r, self._p, self._product])
        self._advance()
        self._total(begin, [self._sums, self._accuracy], [self._which, self._scalars])
        self._launch(turn, [self._scalars, self._z], [self._p])
        look = LOOK["cuda" if self._device.is_cuda else "cpu"]
        for _iteration in range(0, most, look):
            rows = self._which.numpy()
            if (rows < 0).all():
                break
            self._gather(rows[rows >= 0])
            self._iterate(look)
        return self._count.numpy().copy()

    def status(self) -> tuple[np.ndarray, np.ndarray]:
        """Return -(right-hand side) . solution, and True for solves that ended concave (B,).

        Those met a direction along which the tangent is not convex.
        """
        scalars = self._scalars.numpy()
        return scalars[:, 4].copy(), scalars[:, 1] >= CONCAVE

    def _gather(self, running: np.ndarray, *, renew: bool = False) -> None:
        """Launch at most twice as many rows as are running, if rows are gathered at all.

        Args:
            running: Indices of environments.
            renew: True if they are not those of the previous call.
        """
        rows = self._shape[0]
        while self._gathers and rows > 1 and len(running) <= rows // 2:
            rows //= 2
        if renew or rows < len(self._which):
            found = np.full(rows, -1, np.int32)
            found[: len(running)] = running
            self._which = self._all_rows[:rows]
            self._which.assign(found)

    def _iterate(self, times: int) -> None:
        if not self._records:
            for _time in range(times):
                self._once()
            return
        rows = len(self._which), self._preconditioner.ways
        if rows not in self._graphs:
            self._once()  # compiles kernels, which a recording must not
            with wp.ScopedCapture(self._device) as capture:
                for _time in range(times):
                    self._once()
            self._graphs[rows] = capture.graph
            return
        wp.capture_launch(self._graphs[rows])

    def _once(self) -> None:
        _start, _begin, step_length, change, turn = _cg_kernels(self._real, self._lanes)
        self._matrix.product(self._which, self._p, self._product, self._along)
        self._total(step_length, [self._along], [self._which, self._count, self._scalars])
        self._advance()
        self._total(change, [self._sums], [self._which, self._scalars])
        self._launch(turn, [self._scalars, self._z], [self._p])

    def _advance(self) -> None:
        self._preconditioner.advance(
            self._which,
            self._scalars,
            (self._p, self._product),
            (self.solution, self._r, self._z),
            self._sums,
        )

    def _total(self, kernel, inputs, outputs) -> None:
        wp.launch(
            kernel,
            dim=(len(self._which), self._lanes),
            inputs=inputs,
            outputs=outputs,
            device=self._device,
            block_dim=LANES,
        )

    def _launch(self, kernel, inputs, outputs) -> None:
        wp.launch(
            kernel,
            dim=(len(self._which), self._shape[1]),
            inputs=[self._which, *inputs],
            outputs=outputs,
            device=self._device,
        )


# Preconditioner: the tangent without its couplings between vertical columns, solved exactly.
#
# The nodes of a column form a block-tridiagonal system, factored as L D L^T with one 3x3 pivot per
# node (Golub & Van Loan, Matrix Computations, 4th ed., section 4.5.1). The blocks are those of the
# current state: with those of the undeformed body, columns need more iterations than single nodes.
#
# Where the tangent is not convex, a pivot may have eigenvalues that are zero or negative. Those are
# raised to their absolute values or more; L D L^T with positive pivots is positive definite for any
# L.

# Columns per block of GPU threads, which adds up their sums.
BLOCK = 64
# Least eigenvalue of a pivot over the mean diagonal of its block. The ratio of shear to bulk
# modulus at nu = 0.4999 makes it 1e-4; below 1e-6 float32 has no digits left.
PIVOT_LEAST = 1e-5


@functools.cache
def _column_kernels(real):
    vec3 = vector_of(real)
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

    @wp.kernel(enable_backward=False, module="unique")
    def factor(
        # Mesh, and the numbering of nodes along a line
        free: wp.array(dtype=wp.int32),
        inner: int,
        outer: int,
        stride: int,
        next_slot: int,
        # In:
        active: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=mat33),
        # Out: inverse pivots, and each times the coupling to the next node (B, lines, length)
        pivot_out: wp.array3d(dtype=mat33),
        upper_out: wp.array3d(dtype=mat33),
    ):
        env, line = wp.tid()
        if active[env] == 0:
            return
        below = mat33()
        for k in range(pivot_out.shape[2]):
            n = (line // inner) * outer + line % inner + k * stride
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
                coupling = matrix[env, n, next_slot]
                upper = inverse * coupling
                below = wp.transpose(coupling) * upper
            pivot_out[env, line, k] = inverse
            upper_out[env, line, k] = upper

    @wp.func
    def eliminated(
        upper: wp.array3d(dtype=mat33),
        env: int,
        line: int,
        k: int,
        n: int,
        y: vec3,
        z_out: wp.array2d(dtype=vec3),
    ):
        """Store `y`, the solution by L at the line's node k; return its part to subtract next."""
        z_out[env, n] = y
        return wp.transpose(upper[env, line, k]) * y

    @wp.func
    def substituted(
        pivot: wp.array3d(dtype=mat33),
        upper: wp.array3d(dtype=mat33),
        r: wp.array2d(dtype=vec3),
        env: int,
        line: int,
        begin: int,
        stride: int,
        z_out: wp.array2d(dtype=vec3),
    ):
        """Solve by D L^T, backwards from L's solution in `z_out`; return the line's r.z and r.r."""
        length = pivot.shape[2]
        rz = wp.float64(0.0)
        rr = wp.float64(0.0)
        z = vec3()
        for j in range(length):
            k = length - 1 - j
            n = begin + k * stride
            z = pivot[env, line, k] * z_out[env, n] - upper[env, line, k] * z
            z_out[env, n] = z
            rz += wp.float64(wp.dot(r[env, n], z))
            rr += wp.float64(wp.dot(r[env, n], r[env, n]))
        return rz, rr

    @wp.kernel(enable_backward=False, module="unique")
    def along(
        # Numbering of nodes along a line, and the first index of the partial sums
        inner: int,
        outer: int,
        stride: int,
        first: int,
        # In: environments; factors; residual
        which: wp.array(dtype=wp.int32),
        hard: wp.array(dtype=wp.int32),
        pivot: wp.array3d(dtype=mat33),
        upper: wp.array3d(dtype=mat33),
        r: wp.array2d(dtype=vec3),
        # Out: the residual preconditioned by this line
        own_out: wp.array2d(dtype=vec3),
        # In and out: preconditioned residual, to which that is added
        z_out: wp.array2d(dtype=vec3),
        # Out: partial sums of r.z
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        """Add to z the residual preconditioned by the lines along x or y."""
        row, line = wp.tid()
        env = which[row]
        if env < 0:
            return
        if hard[env] == 0:
            return
        begin = (line // inner) * outer + line % inner
        length = pivot.shape[2]
        coupled = vec3()
        for k in range(length):
            n = begin + k * stride
            coupled = eliminated(upper, env, line, k, n, r[env, n] - coupled, own_out)
        rz, _rr = substituted(pivot, upper, r, env, line, begin, stride, own_out)
        for k in range(length):
            n = begin + k * stride
            z_out[env, n] = z_out[env, n] + own_out[env, n]
        sums_out[env, first + line, 0] = rz

    @wp.kernel(enable_backward=False, module="unique")
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
        if env < 0:
            return
        length = real(scalars[env, 2])
        solution_out[env, n] = solution_out[env, n] + p[env, n] * length
        r_out[env, n] = r_out[env, n] - product[env, n] * length

    @wp.kernel(enable_backward=False, module="unique")
    def sweep(
        # In: factors; residual
        which: wp.array(dtype=wp.int32),
        pivot: wp.array3d(dtype=mat33),
        upper: wp.array3d(dtype=mat33),
        r: wp.array2d(dtype=vec3),
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
        if column < pivot.shape[1]:
            levels = pivot.shape[2]
            coupled = vec3()
            for k in range(levels):
                n = column * levels + k
                coupled = eliminated(upper, env, column, k, n, r[env, n] - coupled, z_out)
            rz, rr = substituted(pivot, upper, r, env, column, column * levels, 1, z_out)
        block_rz = wp.tile_sum(wp.tile(rz))
        block_rr = wp.tile_sum(wp.tile(rr))
        if column % BLOCK == 0:
            sums_out[env, column // BLOCK, 0] = block_rz[0]
            sums_out[env, column // BLOCK, 1] = block_rr[0]

    @wp.kernel(enable_backward=False, module="unique")
    def advance(
        # In: factors; step length (B, 2); search direction and the tangent times it
        which: wp.array(dtype=wp.int32),
        pivot: wp.array3d(dtype=mat33),
        upper: wp.array3d(dtype=mat33),
        scalars: wp.array2d(dtype=wp.float64),
        p: wp.array2d(dtype=vec3),
        product: wp.array2d(dtype=vec3),
        # In and out:
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
        levels = pivot.shape[2]
        length = real(scalars[env, 2])
        coupled = vec3()
        for k in range(levels):
            n = column * levels + k
            solution_out[env, n] = solution_out[env, n] + p[env, n] * length
            r = r_out[env, n] - product[env, n] * length
            r_out[env, n] = r
            coupled = eliminated(upper, env, column, k, n, r - coupled, z_out)
        rz, rr = substituted(pivot, upper, r_out, env, column, column * levels, 1, z_out)
        sums_out[env, column, 0] = rz
        sums_out[env, column, 1] = rr

    return factor, along, step, sweep, advance


class _Factors:
    """Factors of the lines of nodes along one axis, for B environments on one grid.

    Args:
        mesh: Grid with its fixed nodes.
        axis: 0, 1 or 2: x, y or z.
        real: Warp's scalar type.
        environments: Number of environments, B.
        device: Device of the factors.
        parallel: Store the factors with line numbers running fastest.
    """

    def __init__(
        self, mesh: Mesh, axis: int, real, environments: int, device: str, *, parallel: bool
    ) -> None:
        self._kernel = _column_kernels(real)[0]
        self._environments, self._device = environments, device
        x, y, z = (cells + 1 for cells in mesh.cells)
        # Number of adjacent lines and the offset from one group of them to the next; the offset
        # from node to node along a line.
        self.order = ((y * z, 0, y * z), (z, y * z, z), (1, z, 1))[axis]
        """Numbering of nodes along lines: group size, group offset, node offset."""
        self._next_slot = (CENTRE + 9, CENTRE + 3, CENTRE + 1)[axis]
        length = (x, y, z)[axis]
        self.lines = len(mesh.nodes) // length
        """Number of lines."""
        shape = (length, self.lines) if parallel else (self.lines, length)
        stored = wp.zeros((2, environments, *shape), matrix_of(real), device=device)
        stored = stored.transpose((0, 1, 3, 2)) if parallel else stored
        self.pivot, self.upper = stored[0], stored[1]
        self._free = wp.array(mesh.free.astype(np.int32), dtype=wp.int32, device=device)

    def make(self, active, matrix) -> None:
        """Factor the lines of active environments, from the blocks (B, N, 27) of the tangent."""
        wp.launch(
            self._kernel,
            dim=(self._environments, self.lines),
            inputs=[self._free, *self.order, self._next_slot, active, matrix],
            outputs=[self.pivot, self.upper],
            device=self._device,
        )


class ColumnPreconditioner:
    """Preconditioner of vertical columns for B environments on one grid; it owns its factors."""

    ways = 1
    """Number of axes along which lines are solved."""

    def __init__(
        self, mesh: Mesh, real, environments: int, device: str, *, parallel: bool | None = None
    ) -> None:
        """Allocate the factors: 72 bytes per node and environment in float32.

        Args:
            mesh: Grid with its fixed nodes.
            real: Warp's scalar type.
            environments: Number of environments, B.
            device: Device of the factors.
            parallel: Store the factors with column numbers running fastest; by default only on a
                GPU.
        """
        self._device = device
        on_gpu = self._on_gpu = wp.get_device(device).is_cuda
        _factor, _along, self._step, self._sweep, self._advance = _column_kernels(real)
        parallel = on_gpu if parallel is None else parallel
        found = self._factors = _Factors(mesh, 2, real, environments, device, parallel=parallel)
        self.parts = -(-found.lines // BLOCK) if on_gpu else found.lines
        """Number of partial sums that `advance` writes for each sum."""

    def factor(self, active, matrix) -> None:
        """Factor the columns of active environments, from the blocks (B, N, 27) of the tangent."""
        self._factors.make(active, matrix)

    def advance(self, which, scalars, along, vectors, sums) -> None:
        """Take a step of conjugate gradients, and precondition the new residual.

        Args:
            which: Indices of environments, int32 (R,); -1: none.
            scalars: Length of the step in column 2 (B, 3 or more), float64.
            along: Search direction and the tangent times it, two (B, N).
            vectors: Solution and residual, which the step changes, and output of the preconditioned
                residual, three (B, N).
            sums: Output of the partial sums of r.z and r.r (B, `parts`, 2), float64.
        """
        if not self._on_gpu:
            wp.launch(
                self._advance,
                dim=(len(which), self._factors.lines),
                inputs=[which, self._factors.pivot, self._factors.upper, scalars, *along],
                outputs=[*vectors, sums],
                device=self._device,
            )
            return
        solution, r, z = vectors
        wp.launch(
            self._step,
            dim=(len(which), r.shape[1]),
            inputs=[which, scalars, *along],
            outputs=[solution, r],
            device=self._device,
        )
        wp.launch(
            self._sweep,
            dim=(len(which), self.parts * BLOCK),
            inputs=[which, self._factors.pivot, self._factors.upper, r],
            outputs=[z, sums],
            device=self._device,
            block_dim=BLOCK,
        )


# Where columns alone need hundreds of iterations, lines along x and y are solved as well.
#
# Couplings between columns are strong where elements are narrow and tall (under a blade), and in
# nearly incompressible bodies (pressure on a column is passed to its neighbours). The solutions
# along the three axes are added up (additive Schwarz: Smith, Bjorstad & Gropp, Domain
# Decomposition, 1996). That reduces the iterations to between a third and a fifth, each taking 1.5
# to 2 times as long.

# Iterations of one solve from which an environment gets lines along all axes. On a GPU one thread
# runs along each line: an iteration takes five times as long, so this is only a last resort.
HARD_FROM = {"cpu": 150, "cuda": 2000}


class Lines:
    """Columns, with lines along x and y for hard environments; interface of `ColumnPreconditioner`.

    Args:
        mesh: Grid with its fixed nodes.
        real: Warp's scalar type.
        environments: Number of environments, B.
        device: Device of the factors.
        parallel: Store the factors with line numbers running fastest; by default only on a GPU.
    """

    def __init__(
        self, mesh: Mesh, real, environments: int, device: str, *, parallel: bool | None = None
    ) -> None:
        self._column_preconditioner = ColumnPreconditioner(
            mesh, real, environments, device, parallel=parallel
        )
        self._mesh, self._real, self._device = mesh, real, device
        self._parallel = wp.get_device(device).is_cuda if parallel is None else parallel
        self._along = _column_kernels(real)[1]
        self._hard_from = HARD_FROM["cuda" if wp.get_device(device).is_cuda else "cpu"]
        x, y, z = (cells + 1 for cells in mesh.cells)
        self.parts = self._column_preconditioner.parts + y * z + x * z
        """Number of partial sums that `advance` writes for each sum."""
        self.hard = np.zeros(environments, bool)
        """True for environments that have lines along all axes (B,)."""
        self._hard = wp.zeros(environments, dtype=wp.int32, device=device)
        self._factors: list[_Factors] = []
        self._own = None

    @property
    def ways(self) -> int:
        """Number of axes along which lines are solved in any environment."""
        return 3 if self._factors else 1

    def learn(self, used: np.ndarray) -> None:
        """Mark environments as hard by the iterations that their last solves have taken (B,)."""
        hard = self.hard | (used >= self._hard_from)
        if (hard == self.hard).all():
            return
        self.hard = hard
        self._hard.assign(hard.astype(np.int32))
        if self._factors:
            return
        real, count, device = self._real, len(hard), self._device
        self._factors = [
            _Factors(self._mesh, axis, real, count, device, parallel=self._parallel)
            for axis in (0, 1)
        ]
        shape = count, len(self._mesh.nodes)
        self._own = wp.zeros(shape, vector_of(real), device=device)

    def factor(self, active, matrix) -> None:
        """Factor the columns, and lines along x and y for hard environments."""
        self._column_preconditioner.factor(active, matrix)
        if not self._factors:
            return
        chosen = (active.numpy().astype(bool) & self.hard).astype(np.int32)
        chosen = wp.array(chosen, dtype=wp.int32, device=self._device)
        for factors in self._factors:
            factors.make(chosen, matrix)

    def advance(self, which, scalars, along, vectors, sums) -> None:
        """Step along p, and precondition with lines along x and y for hard environments."""
        self._column_preconditioner.advance(which, scalars, along, vectors, sums)
        _solution, r, z = vectors
        first = self._column_preconditioner.parts
        for factors in self._factors:
            wp.launch(
                self._along,
                dim=(len(which), factors.lines),
                inputs=[
                    *factors.order,
                    first,
                    which,
                    self._hard,
                    factors.pivot,
                    factors.upper,
                    r,
                ],
                outputs=[self._own, z, sums],
                device=self._device,
            )
            first += factors.lines
