"""A batch of tangents assembled in two ways: by the kernels, and densely by NumPy."""

from typing import Any

import numpy as np
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array, Material

from sim.fem.contact import face_rule
from sim.fem.matrix import SLOTS, BlockMatrix, neighbours
from sim.fem.mesh import Mesh

GRID = oracle.domed_mesh()
# Two bodies on one grid.
MESHES = (GRID, oracle.moved(GRID, 0.06))
COUNT = len(GRID.nodes)
SHAPE = face_rule(2)[0]
# Initial value of the matrix before assembly.
FILLED = 7.0


class Tangents:
    """Three environments on two bodies, the last inactive, with random inputs."""

    def __init__(
        self, variant: str = "elastic", strain: float = 0.02, contact: float = 3.0
    ) -> None:
        random = np.random.default_rng(8)
        self.variant = variant
        self.active = np.array([1, 1, 0])
        self.body = np.array([1, 0, 1])
        self.u = random.normal(0, strain, (3, COUNT, 3)) * GRID.free[:, None]
        self.mass = random.uniform(0.5, 1.5, (2, COUNT))
        self.shift = np.array([0.0, 0.3, 0.6])
        self.stiffer = np.array([0.5, 0.0, 2.0]) if variant == "viscous" else np.zeros(3)
        self.convex = np.zeros(3)
        self.touched = random.integers(0, 2, (3, len(GRID.faces)))
        points = random.normal(0, 1, (3, len(GRID.faces), len(SHAPE), 3, 3))
        self.contact = contact * (points + np.swapaxes(points, -1, -2))
        self.materials = [
            self._material(random, *pair) for pair in ((0.35, 3.3), (0.4, 0.5), (1, 1))
        ]

    def _material(self, random: np.random.Generator, shear: float, bulk: float) -> Material:
        stiffening = 5.0 * ("stiffening" in self.variant)
        if "viscous" not in self.variant:
            return Material(shear, bulk, stiffening=stiffening)
        history = random.normal(0, 0.1, (len(GRID.elements), 8, 3, 3))
        return Material(
            shear,
            bulk,
            factor=1.6 - shear,
            bulk_factor=1.2 + shear,
            history=history + np.swapaxes(history, 2, 3),
            bulk_history=random.normal(0, 0.1, len(GRID.elements)),
            stiffening=stiffening,
        )

    def block_matrix(self, real: Any, *, parallel: bool = False, half: bool = False) -> BlockMatrix:
        """Return the tangent assembled by the kernels over a matrix full of `FILLED`."""
        kinds = {name: name in self.variant for name in ("viscous", "stiffening")}
        kinds["damped"] = kinds["viscous"]
        block_matrix = BlockMatrix(GRID, real, 3, "cpu", **kinds, parallel=parallel, half=half)
        block_matrix.matrix.fill_(FILLED)
        self.assemble(block_matrix, real)
        return block_matrix

    def assemble(self, block_matrix: BlockMatrix, real: Any) -> None:
        """Assemble again for the current state."""
        mesh = oracle.on_device(MESHES, self.body, real)
        mesh.inert = oracle.scalars(self.mass, real)
        contact = oracle.contact_of(
            real,
            touched=oracle.integers(self.touched),
            matrix=oracle.matrices(self.contact, real),
            convex=oracle.integers(self.convex),
        )
        block_matrix.assemble(
            oracle.integers(self.active),
            oracle.vectors(self.u, real),
            mesh,
            oracle.material_of(self.materials, real),
            contact,
            oracle.scalars(self.shift, real),
            oracle.scalars(self.stiffer, real),
        )

    def dense(self, env: int) -> Array:
        """Return the same (N, 3, N, 3) by complex steps, face by face, from the definition."""
        dense = _stiffness(MESHES[self.body[env]], self.u[env], self.materials[env])
        dense *= 1.0 + self.stiffer[env]
        blocks = np.einsum("spij,pa,pb->saibj", self.contact[env], SHAPE, SHAPE)
        for face, touched, block in zip(GRID.faces, self.touched[env], blocks, strict=True):
            dense[np.ix_(face, range(3), face, range(3))] += block * touched
        own = np.arange(COUNT)
        for axis in range(3):
            dense[own, axis, own, axis] += self.shift[env] * self.mass[self.body[env]]
        dense[~GRID.free] = 0.0
        dense[:, :, ~GRID.free] = 0.0
        return dense


def _stiffness(mesh: Mesh, u: Array, material: Material) -> Array:
    """Return the dense tangent of the elements (N, 3, N, 3) by 24 complex steps.

    Nodes of one parity along x, y and z move together: each element has exactly one of them.
    """
    dense = np.zeros((COUNT, 3, COUNT, 3))
    grid = np.stack(np.unravel_index(np.arange(COUNT), np.array(mesh.cells) + 1), axis=-1)
    parity = grid % 2 @ np.array([4, 2, 1])
    for which in range(8):
        moving = mesh.elements[parity[mesh.elements] == which]
        for axis in range(3):
            v = (parity == which)[:, None] * np.eye(3)[axis]
            force = oracle.element_tangent(mesh, u, v, material)
            np.add.at(dense[:, :, :, axis], (mesh.elements, slice(None), moving[:, None]), force)
    return dense


def flat_tangent(by: float) -> BlockMatrix:
    """Return the undeformed tangent of a body whose elements are `by` times as wide as high."""
    nodes = GRID.nodes * np.array([by, by, 1.0])
    jacobian = np.einsum("eai,qaj->eqij", nodes[GRID.elements], oracle.local_gradients())
    one, real = [1.0], wp.float64
    block_matrix = BlockMatrix(GRID, real, 1, "cpu")
    mesh = oracle.on_device([GRID], [0], real)
    mesh.inverse = oracle.matrices(np.linalg.inv(jacobian)[None], real)
    mesh.weight = oracle.scalars(np.linalg.det(jacobian)[None], real)
    mesh.inert = oracle.scalars(np.ones((1, COUNT)), real)
    contact = oracle.contact_of(
        real,
        touched=oracle.integers(np.zeros((1, len(GRID.faces)))),
        matrix=oracle.matrices(np.zeros((1, len(GRID.faces), len(SHAPE), 3, 3)), real),
        convex=oracle.integers([0]),
    )
    block_matrix.assemble(
        oracle.integers(one),
        oracle.vectors(np.zeros((1, COUNT, 3)), real),
        mesh,
        oracle.material_of([Material(0.35, 1.0)], real),
        contact,
        oracle.scalars([0.0], real),
        oracle.scalars([0.0], real),
    )
    return block_matrix


def spread_out(matrix: Array) -> Array:
    """Return the blocks (N, 27, 3, 3) as a dense matrix (N, 3, N, 3)."""
    near = neighbours(GRID.cells)
    dense = np.zeros((COUNT, 3, COUNT, 3))
    for slot in range(SLOTS):
        rows = np.flatnonzero(near[:, slot] >= 0)
        dense[rows, :, near[rows, slot]] = matrix[rows, slot]
    return dense


def columns_of(dense: Array) -> Array:
    """Return the part of a dense tangent within node columns (3N, 3N), with 1 for fixed nodes."""
    column = np.arange(COUNT) // (GRID.cells[2] + 1)
    kept = dense * (column[:, None] == column)[:, None, :, None]
    kept = kept.reshape(3 * COUNT, 3 * COUNT)
    return kept + np.diag(np.repeat(~GRID.free, 3).astype(float))


def applied(one: Any, active: Array, r: Array, real: Any) -> tuple[Array, Array]:
    """Return the preconditioner times r (B, N, 3), from a step of zero length, and r.z (B,)."""
    count = len(r)
    nothing, z = (oracle.vectors(np.full(r.shape, value), real) for value in (0.0, FILLED))
    scalars = wp.zeros((count, 3), dtype=wp.float64, device="cpu")
    sums = wp.zeros((count, one.parts, 2), dtype=wp.float64, device="cpu")
    one.choose(np.flatnonzero(active))
    vectors = nothing, oracle.vectors(r, real), z
    one.advance(oracle.rows(active), scalars, (nothing, nothing), vectors, sums)
    return np.array(z.numpy()), sums.numpy().sum(1)[:, 0]
