# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Tangent assembled on the 27-point stencil of the grid of nodes, and its product with vectors.

`matrix[env, n, s]` is the 3x3 block that couples node n to its neighbour in slot s.
Blocks outside the grid, and in rows and columns of fixed nodes, are zero. Assembly, once per Newton
iteration, costs about as much as 3 matrix-free products; each product is then about ten times
cheaper on a CPU.

There are no atomic additions. Elements add their stiffness; on a GPU one of eight colours after the
other, so that no two at a time share a node, and row by row. `finish` adds the nodal terms.

On a GPU, in float32 and up to `HALF_NODES` and `HALF_POISSON`, products read the matrix rounded to
float16, which halves the memory traffic that takes most of conjugate gradients' time. They solve
for a Newton step to no more than three digits, and its residual is computed from the exact
equations. On finer meshes, and in nearly incompressible bodies, the rounding outweighs the softest
motions, and Newton's method takes three times the iterations or does not end
(docs/decisions/0032).
"""

import functools
from itertools import pairwise

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.device import kernel
from sim.fem.arrays import array_of, contact_struct, mesh_struct
from sim.fem.balance import RUN
from sim.fem.element import ROWS_BLOCK, element_rows_kernel
from sim.fem.lanes import AT_ONCE, blocks_kernel, native_of
from sim.fem.mesh import CORNERS, Mesh
from sim.scalars import matrix_of, vector_of

# Neighbours on the regular grid of nodes: slots of the 27-point stencil, and colours.
#
# A slot is a step (di, dj, dk) of the grid, each -1, 0 or 1: s = 9 (di + 1) + 3 (dj + 1) + dk + 1.

SLOTS = 27
# Slot of a node itself.
CENTRE = 13


def slot_offsets(cells: tuple[int, int, int]) -> NDArray[np.int64]:
    """Return the node number of each slot's neighbour relative to the node (27,)."""
    plane, row = (cells[1] + 1) * (cells[2] + 1), cells[2] + 1
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return steps @ np.array([plane, row, 1])


def neighbours(cells: tuple[int, int, int]) -> NDArray[np.int64]:
    """Return the node of each slot (N, 27); -1 outside the grid."""
    shape = np.array(cells) + 1
    node = np.stack(np.unravel_index(np.arange(shape.prod()), shape), axis=-1)
    steps = np.stack(np.unravel_index(np.arange(SLOTS), (3, 3, 3)), axis=-1) - 1
    there = node[:, None] + steps
    inside = ((there >= 0) & (there < shape)).all(axis=-1)
    return np.where(inside, np.arange(shape.prod())[:, None] + slot_offsets(cells), -1)


def face_slots(mesh: Mesh) -> NDArray[np.int64]:
    """Return the slot of corner b of a face relative to its corner a (S, 4, 4)."""
    difference = mesh.faces[:, None, :] - mesh.faces[:, :, None]
    offsets = slot_offsets(mesh.cells)
    return np.argmax(difference[..., None] == offsets, axis=-1)


def colour_order(cells: tuple[int, int, int]) -> tuple[NDArray[np.int64], list[int]]:
    """Return elements by colour, no two of a colour sharing a node (E,), and colour starts (9,)."""
    parity = np.stack(np.unravel_index(np.arange(np.prod(cells)), cells), axis=-1) % 2
    colour = parity @ np.array([4, 2, 1])
    begins = np.searchsorted(np.sort(colour), np.arange(9))
    return np.argsort(colour, kind="stable"), begins.tolist()


# Product of a row of the stencil with a vector, in a CPU's wide registers.
#
# A row is 27 contiguous blocks of 3x3, 243 numbers. Compiled block by block, a product takes twice
# as long (63 ns a node in place of 28, one core). So rows are written here as vectors of eight
# lanes, which Clang offers for every CPU. Three neighbours in a line are next to each other in
# memory: nine times three blocks make a row.

_LINE = """
    typedef {real} number;
    typedef number wide __attribute__((ext_vector_type(8)));
    typedef number four __attribute__((ext_vector_type(4), aligned(sizeof(number))));
    typedef number eight __attribute__((ext_vector_type(8), aligned(sizeof(number))));
    const number* m = (const number*)((const char*)matrix.data + env * (size_t)matrix.strides[0]
                                      + n * (size_t)matrix.strides[1]);
    const number* x = (const number*)((const char*)v.data + env * (size_t)v.strides[0]);
    const int last = v.shape[1] - 1;
    wide sum0 = 0, sum1 = 0, sum2 = 0;
    number ninth = 0;
    for (int near = 0; near < 9; ++near, m += 27) {{
        const int first = n + offsets.data[3 * near];
        number clamped[9];
        const number* y = x + 3 * first;
        if (first < 0 || first + 2 > last) {{
            for (int i = 0; i < 9; ++i)
                clamped[i] = x[3 * wp::clamp(first + i / 3, 0, last) + i % 3];
            y = clamped;
        }}
        const four a = *(const four*)y, b = *(const four*)(y + 3), c = *(const four*)(y + 5);
        sum0 += *(const eight*)m
              * __builtin_shufflevector(a, a, 0, 1, 2, 0, 1, 2, 0, 1);
        sum1 += *(const eight*)(m + 9)
              * __builtin_shufflevector(b, b, 0, 1, 2, 0, 1, 2, 0, 1);
        sum2 += *(const eight*)(m + 18)
              * __builtin_shufflevector(c, c, 1, 2, 3, 1, 2, 3, 1, 2);
        ninth += m[8] * y[2] + m[17] * y[5] + m[26] * y[8];
    }}
    const wide sum = sum0 + sum1 + sum2;
    return wp::vec_t<3, number>(sum[0] + sum[1] + sum[2], sum[3] + sum[4] + sum[5],
                                sum[6] + sum[7] + ninth);
"""


@functools.cache
def _zero_function(real):
    """Return `zero(numbers, env)`: clear all numbers (B, K) of an environment on a CPU.

    Compiled number by number it takes nearly three times as long.
    """

    @wp.func_native(
        "memset((char*)numbers.data + env * (size_t)numbers.strides[0], 0,"
        " numbers.shape[1] * sizeof(*numbers.data));"
    )
    def zero(numbers: wp.array2d(dtype=real), env: int): ...

    return zero


@functools.cache
def row_function(real, stored, wide: bool):
    """Return `line(offsets, matrix, v, env, n)`: a row of a matrix (B, N, 27) times v (B, N).

    `stored` is the scalar type of the matrix; `wide` is for rows of contiguous blocks on a CPU,
    which are stored as `real`.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    stored33 = matrix_of(stored)
    if wide:

        @wp.func_native(_LINE.format(real=native_of(real)))
        def line(
            offsets: wp.array(dtype=wp.int32),
            matrix: wp.array3d(dtype=mat33),
            v: wp.array2d(dtype=vec3),
            env: int,
            n: int,
        ) -> vec3: ...

        return line

    @wp.func
    def by_blocks(
        offsets: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=stored33),
        v: wp.array2d(dtype=vec3),
        env: int,
        n: int,
    ):
        """Return a row of the matrix times v; blocks outside the grid are zero for any node."""
        last = v.shape[1] - 1
        total = vec3()
        for near in range(9):
            for k in range(3):
                slot = 3 * near + k
                other = wp.clamp(n + offsets[slot], 0, last)
                if wp.static(stored == real):
                    total += matrix[env, n, slot] * v[env, other]
                else:
                    total += mat33(matrix[env, n, slot]) * v[env, other]
        return total

    return by_blocks


# Most nodes of a mesh whose products read the tangent in float16, and largest Poisson's ratio of
# its body. Random scenes on up to 64,000 elements took as many iterations with it, one on 110,000
# three times as many; with 0.499 float32 did not converge where it otherwise does.
HALF_NODES, HALF_POISSON = 60_000, 0.49
# Nodes per block of GPU threads, which adds up their sums.
BLOCK = 128
# Numbers of a matrix that a GPU thread clears or rounds, each next to those of other threads: block
# by block, a thread's 36 bytes of each, reached a fifth of the memory bandwidth of an H200.
APIECE = 64


@functools.cache
def _kernels(real, stored, wide: bool, on_gpu: bool, damped: bool):
    """Return the kernels for one precision; `stored` is the scalar type of the matrix they read.

    `wide` kernels read a whole row of contiguous blocks, as on a CPU. A block of threads with one
    node each adds up its sums if `on_gpu`, else a thread those of a run of nodes. `damped` elements
    are stiffer.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    stored33 = matrix_of(stored)
    zero = _zero_function(real)
    own, lanes = (1, BLOCK) if on_gpu else (RUN, 1)

    @kernel()
    def clear(
        # In:
        active: wp.array(dtype=wp.int32),
        threads: int,
        # Out: all numbers of each environment
        matrix_out: wp.array2d(dtype=real),
    ):
        env, thread = wp.tid()
        if active[env] == 1:
            if wp.static(wide):
                zero(matrix_out, env)
            else:
                for i in range(thread, matrix_out.shape[1], threads):
                    matrix_out[env, i] = real(0.0)

    @kernel()
    def finish(
        mesh: mesh_struct(real),
        contact: contact_struct(real),
        slots: wp.array3d(dtype=wp.int32),
        # Stiffness of a unit volume against any motion, by environment
        shift: wp.array(dtype=real),
        # Further stiffness of the elements over theirs, by environment
        stiffer: wp.array(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        # In and out:
        matrix_out: wp.array3d(dtype=mat33),
    ):
        env, n = wp.tid()
        if active[env] == 0 or mesh.free[n] == 0:
            return
        if wp.static(damped):
            for slot in range(matrix_out.shape[2]):
                matrix_out[env, n, slot] = matrix_out[env, n, slot] * (real(1.0) + stiffer[env])
        own = wp.identity(n=3, dtype=real) * (shift[env] * mesh.inert[mesh.variant[env], n])
        matrix_out[env, n, CENTRE] = matrix_out[env, n, CENTRE] + own
        for k in range(mesh.node_faces.shape[1]):
            place = mesh.node_faces[n, k]
            if place >= 0:
                s = place // 4
                a = place % 4
                if contact.touched[env, s] > 0:
                    for b in range(slots.shape[2]):
                        if mesh.free[mesh.faces[s, b]] == 1:
                            block = mat33()
                            for p in range(mesh.shape.shape[0]):
                                both = mesh.shape[p, a] * mesh.shape[p, b]
                                block += contact.matrix[env, s, p] * both
                            slot = slots[s, a, b]
                            matrix_out[env, n, slot] = matrix_out[env, n, slot] + block

    line = row_function(real, stored, wide)

    @kernel(block=BLOCK)
    def product(
        # Mesh:
        offsets: wp.array(dtype=wp.int32),
        # In:
        which: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=stored33),
        v: wp.array2d(dtype=vec3),
        # Out: matrix times v, and v . (matrix v) of each run of nodes, or block of threads
        product_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        row, item = wp.tid()
        env = which[row]
        if env < 0:
            return
        curvature = wp.float64(0.0)
        for n in range(item * own, wp.min((item + 1) * own, v.shape[1])):
            total = line(offsets, matrix, v, env, n)
            product_out[env, n] = total
            curvature += wp.float64(wp.dot(total, v[env, n]))
        if wp.static(on_gpu):
            curvature = wp.tile_sum(wp.tile(curvature))[0]
        if item % lanes == 0:
            sums_out[env, item // lanes, 0] = curvature

    return clear, finish, product


@functools.cache
def _rounding_kernel(real, stored):
    @kernel()
    def rounded(
        # In: all numbers of each environment
        active: wp.array(dtype=wp.int32),
        threads: int,
        matrix: wp.array2d(dtype=real),
        # Out:
        rounded_out: wp.array2d(dtype=stored),
    ):
        env, thread = wp.tid()
        if active[env] == 1:
            for i in range(thread, matrix.shape[1], threads):
                rounded_out[env, i] = stored(matrix[env, i])

    return rounded


# Most nodes of meshes that are solved side by side: Warp counts the bytes from one environment's
# matrix (float64) to that of the next in 32 bits.
NODES_SIDE_BY_SIDE = (2**31 - 1) // (SLOTS * 72)


def zero_blocks(environments: int, nodes: int, block, device: str, *, parallel: bool) -> wp.array:
    """Return zeros for the blocks of all nodes (B, N, 27); `parallel`: node numbers run fastest.

    Raises:
        ValueError: Several environments have more than `NODES_SIDE_BY_SIDE` nodes.
    """
    if environments > 1 and nodes > NODES_SIDE_BY_SIDE:
        raise ValueError(
            f"{environments} matrices of {nodes} nodes; allowed: {NODES_SIDE_BY_SIDE}, or one"
        )
    if not parallel:
        return wp.zeros((environments, nodes, SLOTS), dtype=block, device=device)
    stored = wp.zeros((environments, SLOTS, nodes), dtype=block, device=device)
    return stored.transpose((0, 2, 1))


def _numbers(blocks: wp.array, scalar) -> wp.array:
    """Return all numbers of each environment (B, N 27 9) in the memory of `zero_blocks`."""
    environments, nodes, slots = blocks.shape
    shape = environments, nodes * slots * 9
    return wp.array(ptr=blocks.ptr, dtype=scalar, shape=shape, device=blocks.device)


class BlockMatrix:
    """Tangents of B environments on one grid; it owns the matrix."""

    def __init__(
        self,
        mesh: Mesh,
        real,
        environments: int,
        device: str,
        *,
        viscous: bool = False,
        split: bool = False,
        stiffening: bool = False,
        parallel: bool | None = None,
        half: bool | None = None,
        damped: bool = False,
    ) -> None:
        """Allocate 972 bytes per node, environment and matrix in float32.

        The mesh gives the grid; its geometry is an argument of every assembly. Compiled in are the
        history of stresses if `viscous`, that of pressures if `split`
        (`sim.fem.element.VolumePressure`), `Fem.stiffening`, and `stiffer` of `assemble` if
        `damped`. `parallel`, by default only on a GPU, assembles by colour with one row of an
        element per thread, and stores the matrix with node numbers running fastest. With `half`
        products read a copy of the matrix in float16, 486 bytes more; it is unsuitable above
        `HALF_POISSON`, and the default in float32 on a GPU, up to `HALF_NODES`.
        """
        count = len(mesh.nodes)
        mat33 = matrix_of(real)
        self._device = device
        self._parallel = wp.get_device(device).is_cuda if parallel is None else parallel
        kernel = element_rows_kernel if self._parallel else blocks_kernel
        self._elements_kernel = kernel(real, viscous, split, stiffening)
        self._environments, self._nodes = environments, count
        self._on_gpu = wp.get_device(device).is_cuda
        if half is None:
            half = self._on_gpu and real == wp.float32 and count <= HALF_NODES
        stored = wp.float16 if half else real
        kernels = _kernels(real, stored, not self._parallel and not half, self._on_gpu, damped)
        self._clear, self._finish, self._product = kernels
        self._round = _rounding_kernel(real, stored) if half else None
        self.parts = -(-count // (BLOCK if self._on_gpu else RUN))
        """Number of partial sums that `product` writes for each sum."""
        if self._parallel:
            order, self._begins = colour_order(mesh.cells)
            self._order = self._integers(order)
        blocks = functools.partial(
            zero_blocks, environments, count, device=device, parallel=self._parallel
        )
        self.matrix = blocks(mat33)
        """Blocks (B, N, 27) of the last assembled state."""
        self._read = blocks(matrix_of(stored)) if half else self.matrix
        self._written = _numbers(self.matrix, real)
        self._rounded = _numbers(self._read, stored) if half else None
        self._threads = -(-self._written.shape[1] // APIECE) if self._on_gpu else 1
        self._elements = len(mesh.elements)
        self._slots = self._integers(face_slots(mesh))
        self._offsets = self._integers(slot_offsets(mesh.cells))

    def assemble(self, active, u, mesh, material, contact, shift, stiffer) -> None:
        """Fill `matrix` of active environments with the tangent at `u` (B, N).

        Mesh, material and contact are structs of `sim.fem.arrays`; `shift` (B,) is the stiffness of
        a unit volume against any motion, and `stiffer` (B,) a further stiffness of elements over
        theirs.
        """
        by_node = self._environments, self._nodes
        by_number = self._environments, self._threads
        self._launch(self._clear, by_number, [active, self._threads], [self._written])
        if self._parallel:
            for first, past in pairwise(self._begins):
                self._launch(
                    self._elements_kernel,
                    (self._environments, len(CORNERS), past - first),
                    [mesh, material, self._order, first, active, u, contact.convex],
                    [self.matrix],
                    block_dim=ROWS_BLOCK,
                )
        else:
            groups = self._environments, -(-self._elements // AT_ONCE)
            inputs = [mesh, material, active, u, contact.convex]
            self._launch(self._elements_kernel, groups, inputs, [self.matrix])
        inputs = [mesh, contact, self._slots, shift, stiffer, active]
        self._launch(self._finish, by_node, inputs, [self.matrix])
        if self._round is not None:
            inputs = [active, self._threads, self._written]
            self._launch(self._round, by_number, inputs, [self._rounded])

    def _launch(self, kernel, dim, inputs, outputs, **options) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self._device, **options)

    def product(self, which, v, product, sums) -> None:
        """Write matrix times `v` and its partial sums, for `ConjugateGradient.solve`.

        Only for the environments with indices in `which`, int32 (R,); -1: none.
        """
        self._launch(
            self._product,
            (len(which), self.parts * (BLOCK if self._on_gpu else 1)),
            [self._offsets, which, self._read, v],
            [product, sums],
            block_dim=BLOCK,
        )

    def _integers(self, values) -> wp.array:
        return array_of(values, wp.int32, wp.float32, self._device)
