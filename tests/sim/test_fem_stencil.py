from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array
from support.fem_tangents import COUNT, FILLED, GRID, Tangents, spread_out

from sim import Body, Effects, Friction, Scene, press, simulate
from sim.fem import Fem, assembly
from sim.fem.balance import RUN
from sim.fem.matrix import SLOTS, BlockMatrix, colour_order, face_slots, neighbours
from sim.indenters import named
from sim.scalars import vector_of

RUNS = -(-COUNT // RUN)
REALS = [
    pytest.param(wp.float64, 1e-12, id="float64"),
    pytest.param(wp.float32, 2e-5, id="float32"),
]


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize(
    ("variant", "real", "error"),
    [
        ("elastic", wp.float64, 1e-12),
        ("elastic", wp.float32, 2e-5),
        ("viscous", wp.float64, 1e-12),
        ("viscous and stiffening", wp.float64, 1e-10),
    ],
)
def test_the_matrix_is_the_derivative_of_the_forces(
    variant: str, real: Any, error: float, parallel: bool
) -> None:
    tangents = Tangents(variant, strain=0.06 if "stiffening" in variant else 0.02)
    matrix = tangents.block_matrix(real, parallel=parallel).matrix.numpy()
    assert matrix.shape == (3, COUNT, SLOTS, 3, 3)
    for env in np.flatnonzero(tangents.active):
        found, expected = spread_out(matrix[env]), tangents.dense(env)
        assert oracle.relative(found, expected) < error
        there = neighbours(GRID.cells) >= 0
        assert not matrix[env][~there].any(), "blocks past the end of the grid are zero"
        asymmetry = np.abs(found - np.transpose(found, (2, 3, 0, 1))).max()
        assert asymmetry < error / 10 * np.abs(found).max()
    assert (matrix[2] == FILLED).all(), "an environment that is off is left alone"


@pytest.mark.parametrize("parallel", [False, True])
def test_a_convex_tangent_has_no_negative_stiffness(parallel: bool) -> None:
    crushed = Tangents(contact=0.0)
    crushed.shift[:] = 0.0
    crushed.u[..., 2] -= 0.4 * (GRID.nodes[:, 2] + 1.0)
    least = [_least_stiffness(crushed, parallel)]
    crushed.convex[:] = 1
    least.append(_least_stiffness(crushed, parallel))
    assert least[0] < -0.01
    assert least[1] > -1e-9


def test_at_rest_the_convex_tangent_is_the_exact_one() -> None:
    rest = Tangents(strain=0.0)
    exact = rest.block_matrix(wp.float64).matrix.numpy()
    rest.convex[:] = 1
    np.testing.assert_allclose(rest.block_matrix(wp.float64).matrix.numpy(), exact, atol=1e-6)


def _least_stiffness(tangents: Tangents, parallel: bool) -> float:
    matrix = tangents.block_matrix(wp.float64, parallel=parallel).matrix.numpy()
    dense = spread_out(matrix[0]).reshape(3 * len(GRID.nodes), -1)
    return float(np.linalg.eigvalsh(dense).min())


def test_a_node_of_the_base_has_neither_row_nor_column() -> None:
    dense = spread_out(Tangents().block_matrix(wp.float64).matrix.numpy()[0])
    assert not dense[~GRID.free].any()
    assert not dense[:, :, ~GRID.free].any()
    own = np.einsum("ninj->nij", dense)[GRID.free]
    assert (np.abs(own).max(axis=(1, 2)) > 0).all()


def test_assembling_again_gives_the_same_bits() -> None:
    tangents = Tangents()
    first = tangents.block_matrix(wp.float32).matrix.numpy()
    np.testing.assert_array_equal(first, tangents.block_matrix(wp.float32).matrix.numpy())


@pytest.mark.parametrize("parallel", [False, True])
def test_assembling_for_another_state_leaves_nothing_of_the_last(parallel: bool) -> None:
    now = Tangents(strain=0.05, contact=5.0)
    block_matrix = Tangents().block_matrix(wp.float64, parallel=parallel)
    now.assemble(block_matrix, wp.float64)
    matrix = block_matrix.matrix.numpy()
    for env in np.flatnonzero(now.active):
        assert oracle.relative(spread_out(matrix[env]), now.dense(env)) < 1e-12
    assert (matrix[2] == FILLED).all()


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize(("real", "error"), REALS)
def test_the_product_is_that_of_the_dense_matrix(real: Any, error: float, parallel: bool) -> None:
    tangents = Tangents()
    block_matrix = tangents.block_matrix(real, parallel=parallel)
    v = np.random.default_rng(2).normal(0, 1, (3, COUNT, 3))
    product = oracle.vectors(np.full((3, COUNT, 3), FILLED), real)
    sums = oracle.zeros((3, RUNS, 3), wp.float64)
    block_matrix.product(oracle.rows(tangents.active), oracle.vectors(v, real), product, sums)
    assert product.dtype == vector_of(real)
    for env in np.flatnonzero(tangents.active):
        expected = np.einsum("nimj,mj->ni", tangents.dense(env), v[env])
        assert oracle.relative(product.numpy()[env], expected) < error
        padded = np.zeros(RUNS * RUN)
        padded[:COUNT] = (expected * v[env]).sum(axis=1)
        by_run = padded.reshape(RUNS, RUN).sum(axis=1)
        assert oracle.relative(sums.numpy()[env, :, 0], by_run) < error
    assert (product.numpy()[2] == FILLED).all()
    assert not sums.numpy()[2].any()
    assert not sums.numpy()[..., 1:].any(), "the other sums are somebody else's"


@pytest.mark.parametrize("parallel", [False, True])
def test_a_product_of_half_the_bytes_keeps_three_digits(parallel: bool) -> None:
    tangents = Tangents()
    block_matrix = tangents.block_matrix(wp.float32, parallel=parallel, half=True)
    v = np.random.default_rng(2).normal(0, 1, (3, COUNT, 3))
    product = oracle.vectors(np.full((3, COUNT, 3), FILLED), wp.float32)
    sums = oracle.zeros((3, RUNS, 3), wp.float64)
    which = oracle.rows(tangents.active)
    block_matrix.product(which, oracle.vectors(v, wp.float32), product, sums)
    for env in np.flatnonzero(tangents.active):
        rounded = np.abs(tangents.dense(env)).max() * 2.0**-11
        expected = np.einsum("nimj,mj->ni", tangents.dense(env), v[env])
        off = np.abs(product.numpy()[env] - expected).max()
        assert 0 < off < 4 * rounded * np.sqrt(81)
    assert (product.numpy()[2] == FILLED).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "poisson"), [("sphere", 0.45), ("dots", 0.49)])
def test_a_press_takes_no_more_iterations_with_it(
    monkeypatch: pytest.MonkeyPatch, name: str, poisson: float
) -> None:
    body = Body(8e-3, 8e-3, 4e-3, poisson=poisson)
    scene = Scene(named(name), press([0.6e-3]), body, Effects(friction=Friction(0.8)))
    numerics = Fem(spacing=4e-3 / 3, precision="float32", tolerance=1e-3)
    plain = simulate(scene, numerics)

    def rounded(*arguments: Any, **options: Any) -> BlockMatrix:
        return BlockMatrix(*arguments, **{**options, "half": True})

    monkeypatch.setattr(assembly, "BlockMatrix", rounded)
    half = simulate(scene, numerics)
    assert not np.array_equal(half.wrench, plain.wrench), "nothing was rounded"
    np.testing.assert_allclose(half.force[-1, 2], plain.force[-1, 2], rtol=2e-3)
    assert half.quality.newton.sum() <= 1.1 * plain.quality.newton.sum()
    assert half.quality.cg.sum() <= 1.1 * plain.quality.cg.sum()


def test_neighbours_are_one_step_of_the_grid_away() -> None:
    cells = (3, 4, 5)
    place = np.stack(np.unravel_index(np.arange(120), (4, 5, 6)), axis=-1)
    near = neighbours(cells)
    for slot in range(SLOTS):
        step = np.array([slot // 9, slot // 3 % 3, slot % 3]) - 1
        rows = near[:, slot] >= 0
        np.testing.assert_array_equal(place[near[rows, slot]], (place + step)[rows])
        outside = ((place + step < 0) | (place + step > np.array(cells))).any(axis=1)
        np.testing.assert_array_equal(outside, ~rows)


def test_slots_of_a_face_lead_to_its_corners() -> None:
    near, slots = neighbours(GRID.cells), face_slots(GRID)
    for a in range(4):
        for b in range(4):
            found = near[GRID.faces[:, a], slots[:, a, b]]
            np.testing.assert_array_equal(found, GRID.faces[:, b])


def test_elements_of_one_colour_share_no_node() -> None:
    order, begins = colour_order(GRID.cells)
    assert sorted(order) == list(range(len(GRID.elements)))
    assert begins[0] == 0
    assert begins[-1] == len(order)
    for first, past in pairwise(begins):
        nodes: Array = GRID.elements[order[first:past]].ravel()
        assert len(np.unique(nodes)) == len(nodes)
