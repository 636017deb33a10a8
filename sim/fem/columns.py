# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Preconditioner: the tangent without its couplings between vertical columns, solved exactly.

The nodes of a column make a block-tridiagonal system, factored as L D L^T with one 3x3 pivot a node
(Golub & Van Loan, Matrix Computations, 4th ed., section 4.5.1). The blocks are those of the state:
made of the undeformed body's, columns need more iterations than single nodes do.

Where the tangent is not convex, a pivot may have eigenvalues that are zero or negative. Those are
lifted, to their absolute values at least; L D L^T with positive pivots is positive definite
whatever L is.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.grid import CENTRE
from sim.fem.mesh import Mesh
from sim.fem.scalars import matrix_of, vector_of

ABOVE = CENTRE + 1
"""Slot of the node above."""
BLOCK = 64
"""Columns that one block of a GPU's threads takes, whose sums it adds up."""
PIVOT_LEAST = 1e-5
"""Least eigenvalue of a pivot over the mean diagonal of its block. Shear against bulk modulus at
nu = 0.4999 makes 1e-4 of it; below 1e-6 float32 has no digits left."""


@functools.cache
def _kernels(real):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    half, third, least = real(0.5), real(1.0 / 3.0), real(PIVOT_LEAST)

    @wp.func
    def positive(a: mat33):
        """Whether a symmetric matrix is positive definite, by its leading minors."""
        return (
            a[0, 0] > real(0.0)
            and a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0] > real(0.0)
            and wp.determinant(a) > real(0.0)
        )

    @wp.func
    def lifted(a: mat33, floor: real):
        """The symmetric matrix with every eigenvalue at least `floor` and its absolute value."""
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
        # Out: inverse pivots, and each times the coupling to the node above (B, columns, levels)
        pivot_out: wp.array3d(dtype=mat33),
        upper_out: wp.array3d(dtype=mat33),
    ):
        env, column = wp.tid()
        if active[env] == 0:
            return
        levels = pivot_out.shape[2]
        below = mat33()
        for k in range(levels):
            n = column * levels + k
            inverse = mat33()
            upper = mat33()
            if free[n] == 1:
                block = matrix[env, n, CENTRE]
                size = wp.abs(block[0, 0]) + wp.abs(block[1, 1]) + wp.abs(block[2, 2])
                floor = least * third * size
                pivot = block - below
                pivot = (pivot + wp.transpose(pivot)) * half
                if not positive(pivot - wp.identity(n=3, dtype=real) * floor):
                    pivot = lifted(pivot, floor)
                inverse = wp.inverse(pivot)
                coupling = matrix[env, n, ABOVE]
                upper = inverse * coupling
                below = wp.transpose(coupling) * upper
            pivot_out[env, column, k] = inverse
            upper_out[env, column, k] = upper

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
        """What a thread for each node does before `sweep`: neighbours in memory go together."""
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
        # Out: preconditioned residual, and shares of r.z and r.r
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
            first = column * levels
            carried = vec3()
            for k in range(levels):
                y = r[env, first + k] - carried
                z_out[env, first + k] = y
                carried = wp.transpose(upper[env, column, k]) * y
            z = vec3()
            for j in range(levels):
                k = levels - 1 - j
                n = first + k
                z = pivot[env, column, k] * z_out[env, n] - upper[env, column, k] * z
                z_out[env, n] = z
                rz += wp.float64(wp.dot(r[env, n], z))
                rr += wp.float64(wp.dot(r[env, n], r[env, n]))
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
        # Out: preconditioned residual, and shares of r.z and r.r
        z_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        row, column = wp.tid()
        env = which[row]
        if env < 0:
            return
        rz = wp.float64(0.0)
        rr = wp.float64(0.0)
        levels = pivot.shape[2]
        first = column * levels
        length = real(scalars[env, 2])
        carried = vec3()
        for k in range(levels):
            n = first + k
            solution_out[env, n] = solution_out[env, n] + p[env, n] * length
            r = r_out[env, n] - product[env, n] * length
            r_out[env, n] = r
            y = r - carried
            z_out[env, n] = y
            carried = wp.transpose(upper[env, column, k]) * y
        z = vec3()
        for j in range(levels):
            k = levels - 1 - j
            n = first + k
            z = pivot[env, column, k] * z_out[env, n] - upper[env, column, k] * z
            z_out[env, n] = z
            r = r_out[env, n]
            rz += wp.float64(wp.dot(r, z))
            rr += wp.float64(wp.dot(r, r))
        sums_out[env, column, 0] = rz
        sums_out[env, column, 1] = rr

    return factor, step, sweep, advance


class Columns:
    """The preconditioner of B environments on one grid; owns its factors."""

    def __init__(
        self, mesh: Mesh, real, environments: int, device: str, *, parallel: bool | None = None
    ) -> None:
        """Make room for the factors: 72 bytes for each node and environment in float32.

        Args:
            mesh: Grid, and which nodes are held.
            real: Warp's scalar type.
            environments: How many, B.
            device: Where.
            parallel: Whether column numbers run fastest in memory. On a GPU, when not said.
        """
        self._device = device
        on_gpu = self._on_gpu = wp.get_device(device).is_cuda
        self._factor, self._step, self._sweep, self._advance = _kernels(real)
        levels = mesh.cells[2] + 1
        columns = len(mesh.nodes) // levels
        self._launched = (environments, columns)
        self.parts = -(-columns // BLOCK) if on_gpu else columns
        """How many shares `advance` writes of each sum."""
        if on_gpu if parallel is None else parallel:
            stored = wp.zeros((2, environments, levels, columns), matrix_of(real), device=device)
            stored = stored.transpose((0, 1, 3, 2))
        else:
            stored = wp.zeros((2, environments, columns, levels), matrix_of(real), device=device)
        self._pivot, self._upper = stored[0], stored[1]
        self._free = wp.array(mesh.free.astype(np.int32), dtype=wp.int32, device=device)

    def factor(self, active, matrix) -> None:
        """Factor the columns of active environments, from the blocks (B, N, 27) of a `Stencil`."""
        wp.launch(
            self._factor,
            dim=self._launched,
            inputs=[self._free, active, matrix],
            outputs=[self._pivot, self._upper],
            device=self._device,
        )

    def advance(self, which, scalars, along, vectors, sums) -> None:
        """Go a step of conjugate gradients, and precondition the residual that it leaves.

        Args:
            which: Numbers of environments, int32 (R,); -1: none.
            scalars: Length of the step in column 2 (B, 3 or more), float64.
            along: Search direction and the tangent times it, two (B, N).
            vectors: Solution and residual, which the step changes, and where the preconditioned
                residual goes, three (B, N).
            sums: Where the shares of r.z and r.r go (B, `parts`, 2), float64.
        """
        if not self._on_gpu:
            wp.launch(
                self._advance,
                dim=(len(which), self._launched[1]),
                inputs=[which, self._pivot, self._upper, scalars, *along],
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
            inputs=[which, self._pivot, self._upper, r],
            outputs=[z, sums],
            device=self._device,
            block_dim=BLOCK,
        )
