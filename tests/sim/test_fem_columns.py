from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array
from support.fem_tangents import (
    COUNT,
    FILLED,
    GRID,
    Tangents,
    applied,
    columns_of,
    flat_tangent,
    spread_out,
)
from support.few import few

from sim.fem.multigrid import Multigrid

FREE = np.repeat(GRID.free, 3)
REALS = [
    pytest.param(wp.float64, 1e-11, id="float64"),
    pytest.param(wp.float32, 3e-4, id="float32"),
]


def _inverse(tangents: Tangents, real: Any, env: int) -> Array:
    """Return the preconditioner as a dense matrix, by applying it to unit vectors."""
    columns = Multigrid([GRID], np.zeros(3, int), real, "cpu")
    active = oracle.integers(tangents.active)
    columns.factor(active, tangents.block_matrix(real).matrix)
    dense = np.empty((3 * COUNT, 3 * COUNT))
    for unit, row in zip(np.eye(3 * COUNT), dense, strict=True):
        r = np.broadcast_to(unit.reshape(COUNT, 3), (3, COUNT, 3))
        row[:] = applied(columns, active.numpy(), r, real)[0][env].ravel()
    return dense.T


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize(("real", "error"), few(REALS, 1))
def test_columns_are_solved_as_a_dense_matrix_is(real: Any, error: float, parallel: bool) -> None:
    tangents = Tangents(strain=0.005, contact=0.0)
    block_matrix = tangents.block_matrix(real)
    columns = Multigrid([GRID], np.zeros(3, int), real, "cpu", parallel=parallel)
    active = oracle.integers(tangents.active)
    columns.factor(active, block_matrix.matrix)
    r = np.random.default_rng(4).normal(0, 1, (3, COUNT, 3))
    z = applied(columns, active.numpy(), r, real)[0]
    for env in np.flatnonzero(tangents.active):
        kept = columns_of(tangents.dense(env))
        assert np.linalg.eigvalsh(kept).min() > 0
        expected = np.linalg.solve(kept, np.where(FREE, r[env].ravel(), 0.0))
        assert oracle.relative(z[env].ravel(), expected) < error
        assert not z[env][~GRID.free].any(), "held nodes do not move"
    assert (z[2] == FILLED).all(), "an environment that is off is left alone"


@pytest.mark.parametrize("real", [wp.float64, wp.float32])
def test_the_preconditioner_is_positive_where_the_tangent_is_not(real: Any) -> None:
    """Contact of either sign, stiffer than the body, on the top and on the sides."""
    tangents = Tangents(contact=30.0)
    kept = columns_of(tangents.dense(0))
    assert np.linalg.eigvalsh(kept).min() < -1, "these columns are far from positive definite"
    inverse = _inverse(tangents, real, 0)[np.ix_(FREE, FREE)]
    assert np.abs(inverse - inverse.T).max() < 1e-4 * np.abs(inverse).max()
    assert np.linalg.eigvalsh((inverse + inverse.T) / 2).min() > 0


def test_lifting_a_pivot_keeps_its_size() -> None:
    """One top node has the pivot -P instead of P: it is replaced by P."""
    tangents = Tangents(strain=0.005, contact=0.0)
    matrix = tangents.block_matrix(wp.float64).matrix.numpy()
    levels = GRID.cells[2] + 1
    top = levels - 1
    kept = columns_of(spread_out(matrix[0]))[: 3 * levels, : 3 * levels]
    inside, across = kept[: 3 * top, : 3 * top], kept[: 3 * top, 3 * top :]
    pivot = kept[3 * top :, 3 * top :] - across.T @ np.linalg.solve(inside, across)
    matrix[0, top, 13] -= 2 * pivot
    columns = Multigrid([GRID], np.zeros(3, int), wp.float64, "cpu")
    active = oracle.integers(tangents.active)
    columns.factor(active, oracle.matrices(matrix, wp.float64))
    r = np.zeros((3, COUNT, 3))
    r[0, :levels] = np.random.default_rng(4).normal(0, 1, (levels, 3))
    r[0, 0] = 0.0
    z = applied(columns, active.numpy(), r, wp.float64)[0]
    expected = np.linalg.solve(kept, r[0, :levels].ravel())
    assert oracle.relative(z[0, :levels].ravel(), expected) < 1e-9


def test_flat_elements_need_less_than_half_the_iterations_of_single_nodes() -> None:
    """Elements 6 times as wide as high: the couplings along a column are the strong ones."""
    block_matrix = flat_tangent(6.0)
    columns = Multigrid([GRID], np.zeros(1, int), wp.float64, "cpu")
    active = oracle.integers([1])
    columns.factor(active, block_matrix.matrix)
    dense = spread_out(block_matrix.matrix.numpy()[0])
    nodes = np.zeros((COUNT, 3, 3))
    nodes[GRID.free] = np.linalg.inv(np.einsum("ninj->nij", dense)[GRID.free])

    def along(r: Array) -> Array:
        return np.array(applied(columns, active.numpy(), r[None], wp.float64)[0][0])

    by_node = _iterations(dense, lambda r: np.einsum("nij,nj->ni", nodes, r))
    assert _iterations(dense, along) < 0.5 * by_node


def test_a_step_moves_solution_and_residual_and_adds_up_the_products() -> None:
    tangents = Tangents(strain=0.005, contact=0.0)
    columns = Multigrid([GRID], np.zeros(3, int), wp.float64, "cpu")
    active = oracle.integers(tangents.active)
    columns.factor(active, tangents.block_matrix(wp.float64).matrix)
    p, product, solution, r = np.random.default_rng(7).normal(0, 1, (4, 3, COUNT, 3))
    length = np.array([0.5, -2.0, 3.0])
    scalars = wp.array(np.outer(length, [0, 0, 1.0]), dtype=wp.float64, device="cpu")
    sums = wp.zeros((3, columns.parts, 2), dtype=wp.float64, device="cpu")
    along = oracle.vectors(p, wp.float64), oracle.vectors(product, wp.float64)
    vectors = [oracle.vectors(each, wp.float64) for each in (solution, r, np.zeros_like(r))]
    columns.advance(oracle.rows(tangents.active), scalars, along, vectors, sums)
    on = tangents.active.astype(bool)
    step = np.where(on, length, 0.0)[:, None, None]
    found, left, z = (each.numpy() for each in vectors)
    np.testing.assert_allclose(found, solution + step * p, rtol=1e-12)
    np.testing.assert_allclose(left, r - step * product, rtol=1e-12, atol=1e-12)
    totals = np.stack([(left * z).sum((1, 2)), (left**2).sum((1, 2))], axis=1)
    np.testing.assert_allclose(sums.numpy().sum(1)[on], totals[on], rtol=1e-12)
    assert not sums.numpy()[~on].any()


def _iterations(dense: Array, precondition: Callable[[Array], Array]) -> int:
    """Return the iterations of a plain conjugate gradient solve to 1e-6."""
    r = np.random.default_rng(1).normal(0, 1, (COUNT, 3)) * GRID.free[:, None]
    target = 1e-6 * np.linalg.norm(r)
    z = precondition(r)
    p, rz = z, (r * z).sum()
    for count in range(1, 1000):
        product = np.einsum("nimj,mj->ni", dense, p)
        r = r - product * (rz / (p * product).sum())
        if np.linalg.norm(r) < target:
            return count
        z = precondition(r)
        p, rz = z + p * ((r * z).sum() / rz), (r * z).sum()
    raise AssertionError("not solved within 1000 iterations")
