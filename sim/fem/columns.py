# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Preconditioner: the tangent without its couplings between vertical columns, solved exactly.

The nodes of a column form a block-tridiagonal system, factored as L D L^T with one 3x3 pivot per
node (Golub & Van Loan, Matrix Computations, 4th ed., section 4.5.1). The blocks are those of the
current state: with those of the undeformed body, columns need more iterations than single nodes.

Where the tangent is not convex, a pivot may have eigenvalues that are zero or negative. Those are
raised to their absolute values or more; L D L^T with positive pivots is positive definite for any
L.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.mesh import CENTRE, Mesh
from sim.scalars import matrix_of, vector_of

# Columns per block of GPU threads, which adds up their sums.
BLOCK = 64
# Least eigenvalue of a pivot over the mean diagonal of its block. The ratio of shear to bulk
# modulus at nu = 0.4999 makes it 1e-4; below 1e-6 float32 has no digits left.
PIVOT_LEAST = 1e-5


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

    @wp.kernel(enable_backward=False, module="unique")
    def factor(
        # Mesh:
        free: wp.array(dtype=wp.int32),
        # In:
        active: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=mat33),
        # Out: inverse pivots, and each times the coupling to the node above (B, columns, Z)
        pivot_out: wp.array3d(dtype=mat33),
        upper_out: wp.array3d(dtype=mat33),
    ):
        env, column = wp.tid()
        if active[env] == 0:
            return
        below = mat33()
        levels = pivot_out.shape[2]
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
            pivot_out[env, column, k] = inverse
            upper_out[env, column, k] = upper

    return factor


@functools.cache
def column_functions(real):
    """Return `eliminated` and `substituted`, which solve a column forwards and backwards."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)

    @wp.func
    def eliminated(
        upper: wp.array3d(dtype=mat33),
        env: int,
        column: int,
        k: int,
        n: int,
        y: vec3,
        y_out: wp.array2d(dtype=vec3),
    ):
        """Store `y`, the solution by L at the column's node k; return its part to subtract next."""
        y_out[env, n] = y
        return wp.transpose(upper[env, column, k]) * y

    @wp.func
    def substituted(
        pivot: wp.array3d(dtype=mat33),
        upper: wp.array3d(dtype=mat33),
        y: wp.array2d(dtype=vec3),
        env: int,
        column: int,
        k: int,
        n: int,
        z: vec3,
    ):
        """Return the solution at the column's node k, from L's in `y` and `z`, that above it."""
        return pivot[env, column, k] * y[env, n] - upper[env, column, k] * z

    return eliminated, substituted


@functools.cache
def _column_kernels(real):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    eliminated, substituted = column_functions(real)

    @wp.func
    def solved(
        pivot: wp.array3d(dtype=mat33),
        upper: wp.array3d(dtype=mat33),
        r: wp.array2d(dtype=vec3),
        env: int,
        column: int,
        z_out: wp.array2d(dtype=vec3),
    ):
        """Solve by D L^T, downwards from L's solution in `z_out`; return the column's r.z, r.r."""
        levels = pivot.shape[2]
        rz = wp.float64(0.0)
        rr = wp.float64(0.0)
        z = vec3()
        for j in range(levels):
            k = levels - 1 - j
            n = column * levels + k
            z = substituted(pivot, upper, z_out, env, column, k, n, z)
            z_out[env, n] = z
            rz += wp.float64(wp.dot(r[env, n], z))
            rr += wp.float64(wp.dot(r[env, n], r[env, n]))
        return rz, rr

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
            rz, rr = solved(pivot, upper, r, env, column, z_out)
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
        rz, rr = solved(pivot, upper, r_out, env, column, z_out)
        sums_out[env, column, 0] = rz
        sums_out[env, column, 1] = rr

    return step, sweep, advance


class Factors:
    """Factors of the columns of B environments on one grid.

    Args:
        free: True for nodes that move (N,).
        levels: Number of nodes of a column, Z.
        real: Warp's scalar type.
        environments: Number of environments, B.
        device: Device of the factors.
        parallel: Store the factors with column numbers running fastest.
    """

    def __init__(
        self, free, levels: int, real, environments: int, device: str, *, parallel: bool
    ) -> None:
        self._environments, self._device, self._real = environments, device, real
        self.columns = len(free) // levels
        """Number of columns."""
        shape = (levels, self.columns) if parallel else (self.columns, levels)
        stored = wp.zeros((2, environments, *shape), matrix_of(real), device=device)
        stored = stored.transpose((0, 1, 3, 2)) if parallel else stored
        self.pivot, self.upper = stored[0], stored[1]
        self._free = wp.array(free.astype(np.int32), dtype=wp.int32, device=device)

    def make(self, active, matrix) -> None:
        """Factor the columns of active environments, from the blocks (B, N, 27) of the tangent."""
        wp.launch(
            _factor_kernel(self._real),
            dim=(self._environments, self.columns),
            inputs=[self._free, active, matrix],
            outputs=[self.pivot, self.upper],
            device=self._device,
        )


class ColumnPreconditioner:
    """Preconditioner of vertical columns for B environments on one grid; it owns its factors."""

    grids = 1
    """Number of grids."""

    def choose(self, _running) -> int:
        """Return the number of grids that environments need."""
        return self.grids

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
        self._step, self._sweep, self._advance = _column_kernels(real)
        parallel = on_gpu if parallel is None else parallel
        levels = mesh.cells[2] + 1
        self.factors = Factors(mesh.free, levels, real, environments, device, parallel=parallel)
        """Factors of the columns."""
        columns = self.factors.columns
        self.parts = -(-columns // BLOCK) if on_gpu else columns
        """Number of partial sums that `advance` writes for each sum."""

    def factor(self, active, matrix) -> None:
        """Factor the columns of active environments, from the blocks (B, N, 27) of the tangent."""
        self.factors.make(active, matrix)

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
                dim=(len(which), self.factors.columns),
                inputs=[which, self.factors.pivot, self.factors.upper, scalars, *along],
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
            inputs=[which, self.factors.pivot, self.factors.upper, r],
            outputs=[z, sums],
            device=self._device,
            block_dim=BLOCK,
        )
