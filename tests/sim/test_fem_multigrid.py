from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array
from support.fem_tangents import COUNT, FILLED, GRID, MESHES, Tangents, applied
from support.few import few

from sim import simulate
from sim.fem import Fem, multigrid
from sim.fem.multigrid import SMOOTHING, Multigrid, grid_counts, thinned
from sim.indenters import shapes
from sim.scene import Body, Scene, press

FREE = np.repeat(GRID.free, 3)
LEVELS = GRID.cells[2] + 1
# Environments that need coarser grids: the first, on the second body, and the last, which is off.
HARD = np.array([multigrid.HARD_FROM["cpu"], 0, multigrid.HARD_FROM["cpu"]])
REALS = [
    pytest.param(wp.float64, 1e-10, id="float64"),
    pytest.param(wp.float32, 1e-3, id="float32"),
]


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test's grid has elements as wide as high, so let coarsening go on for longer."""
    monkeypatch.setattr(multigrid, "COARSEST_SPACING", 1e3)


def _made(tangents: Tangents, real: Any, *, parallel: bool = False) -> Multigrid:
    made = Multigrid(list(MESHES), tangents.body, real, "cpu", parallel=parallel)
    made.learn(HARD, np.full(3, 1e-2))
    matrix = tangents.block_matrix(real, parallel=parallel).matrix
    for factor in made.factor, made.factor_grids:
        factor(oracle.integers(tangents.active), matrix)
    return made


def _dense(one: Multigrid, active: Array, real: Any) -> Array:
    """Return the first environment's preconditioner, by applying it to unit vectors."""
    found = [
        applied(one, active, np.broadcast_to(unit.reshape(COUNT, 3), (3, COUNT, 3)), real)[0][0]
        for unit in np.eye(3 * COUNT)[FREE]
    ]
    return np.array(found).reshape(len(found), -1)[:, FREE]


def _cycle(tangent: Array, x: Array, y: Array, counts: list[tuple[int, int]]) -> Array:
    """Return the V-cycle of a tangent (3 N, 3 N) with nodes at x, y as a dense matrix."""
    live = np.diagonal(tangent) > 0
    within = np.zeros_like(tangent)
    columns = np.arange(len(x) * len(y)).repeat(3 * LEVELS)
    within[np.ix_(live, live)] = np.linalg.inv(
        np.where(columns[:, None] == columns, tangent, 0.0)[np.ix_(live, live)]
    )
    smooth, unit = SMOOTHING * within, np.eye(len(tangent))
    if not counts:
        return smooth
    kept_x, kept_y = thinned(x, counts[0][0]), thinned(y, counts[0][1])
    along_x, along_y = (
        np.array([np.interp(all_, all_[kept], one) for one in np.eye(len(kept))]).T
        for all_, kept in ((x, kept_x), (y, kept_y))
    )
    up = np.kron(np.kron(along_x, along_y), np.eye(3 * LEVELS))
    below = _cycle(up.T @ tangent @ up, x[kept_x], y[kept_y], counts[1:])
    rest = unit - smooth @ tangent
    moved = (smooth + up @ below @ up.T @ (unit - tangent @ smooth)) * live[:, None]
    return rest @ moved + smooth


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize(("real", "error"), few(REALS, 1))
def test_it_is_the_cycle_of_dense_matrices(real: Any, error: float, parallel: bool) -> None:
    tangents = Tangents(strain=0.005, contact=0.0)
    made = _made(tangents, real, parallel=parallel)
    r = np.random.default_rng(4).normal(0, 1, (3, COUNT, 3))
    z, rz = applied(made, tangents.active, r, real)
    # The grids are chosen on the first body; the first environment's is the second.
    counts = grid_counts(GRID.x, GRID.y)
    assert counts, "the grid can be coarsened"
    mesh = MESHES[tangents.body[0]]
    dense = tangents.dense(0).reshape(3 * COUNT, -1)
    expected = _cycle(dense, mesh.x, mesh.y, counts) @ np.where(FREE, r[0].ravel(), 0.0)
    assert oracle.relative(z[0].ravel(), expected) < error
    assert oracle.relative(rz[0], (r[0] * z[0]).sum()) < error
    assert not z[0][~GRID.free].any(), "held nodes do not move"


def test_an_environment_that_is_not_hard_has_columns_alone() -> None:
    tangents = Tangents(strain=0.005, contact=0.0)
    made = _made(tangents, wp.float64)
    columns = Multigrid([GRID], np.zeros(3, int), wp.float64, "cpu")
    columns.factor(oracle.integers(tangents.active), tangents.block_matrix(wp.float64).matrix)
    r = np.random.default_rng(4).normal(0, 1, (3, COUNT, 3))
    (z, rz), (alone, alone_rz) = (
        applied(one, tangents.active, r, wp.float64) for one in (made, columns)
    )
    np.testing.assert_array_equal(z[1:], alone[1:])
    np.testing.assert_array_equal(rz[1:], alone_rz[1:])
    assert (z[2] == FILLED).all(), "an environment that is off is left alone"
    assert np.abs(z[0] - alone[0]).max() > 0.1 * np.abs(alone[0]).max()
    assert made.choose(np.array([1])) == 1, "grids are left out where no running one needs them"


def test_it_is_symmetric_and_positive_where_the_tangent_is() -> None:
    tangents = Tangents(strain=0.005, contact=0.0)
    dense = tangents.dense(0).reshape(3 * COUNT, -1)[np.ix_(FREE, FREE)]
    assert np.linalg.eigvalsh(dense).min() > 0
    inverse = _dense(_made(tangents, wp.float64), tangents.active, wp.float64)
    assert np.abs(inverse - inverse.T).max() < 1e-9 * np.abs(inverse).max()
    values = np.linalg.eigvals(inverse @ dense).real
    assert values.min() > 0
    assert values.max() < 2, "the cycle alone converges"


def test_grids_are_made_again_only_when_solves_slow_down() -> None:
    tangents = Tangents(strain=0.005, contact=0.0)
    made = _made(tangents, wp.float64)
    r = np.random.default_rng(4).normal(0, 1, (3, COUNT, 3))
    first = applied(made, tangents.active, r, wp.float64)[0][0]
    tangents.shift[0] = 3.0
    stiffer, active = tangents.block_matrix(wp.float64).matrix, oracle.integers(tangents.active)
    found = []
    for used in (10, 12, 40):
        made.learn(np.array([used, 0, 0]), np.full(3, 1e-2))
        made.factor(active, stiffer)
        made.factor_grids(active, stiffer)
        found.append(applied(made, tangents.active, r, wp.float64)[0][0])
    dense = tangents.dense(0).reshape(3 * COUNT, -1)
    mesh = MESHES[tangents.body[0]]
    cycle = _cycle(dense, mesh.x, mesh.y, grid_counts(GRID.x, GRID.y))
    expected = cycle @ np.where(FREE, r[0].ravel(), 0.0)
    assert oracle.relative(found[2].ravel(), expected) < 1e-10
    assert oracle.relative(found[1].ravel(), expected) > 1e-4, "coarser grids were kept"
    assert oracle.relative(found[0], found[1]) < 1e-12
    assert oracle.relative(first, found[1]) > 1e-4, "columns are those of the tangent itself"


def test_points_that_are_left_out_are_those_closest_together() -> None:
    x = np.array([0.0, 0.1, 0.2, 0.3, 1.0, 2.0])
    np.testing.assert_array_equal(thinned(x, 6), np.arange(6))
    assert list(x[thinned(x, 4)]) == [0.0, 0.3, 1.0, 2.0]
    assert list(x[thinned(x, 2)]) == [0.0, 2.0]


def test_each_grid_keeps_at_most_half_of_the_nodes_until_it_is_as_wide_as_the_body_is_thick(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(multigrid, "COARSEST_SPACING", 1.0)
    fine = np.concatenate([np.linspace(-4, -0.2, 12), np.linspace(-0.19, 4, 60)])
    even = np.linspace(-2, 2, 81)
    counts = [(len(fine), len(even)), *grid_counts(fine, even)]
    for before, after in pairwise(counts[:-1]):
        assert after[0] * after[1] <= 0.5 * before[0] * before[1]
    for length, count in zip((8.0, 4.0), counts[-1], strict=True):
        assert 0.6 < length / (count - 1) < 1.5
    assert grid_counts(np.linspace(-9, 9, 10), np.linspace(-9, 9, 10)) == []


@pytest.mark.slow
def test_a_blade_takes_a_fifth_of_the_iterations_of_columns_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(multigrid, "COARSEST_SPACING", 1.0)
    blade = Scene(shapes.box(0.3e-3, 4e-3, 0.1e-3), press([0.05e-3]), Body(6e-3, 6e-3, 2e-3))
    found = []
    for hard_from in (10**9, 20):
        monkeypatch.setattr(multigrid, "HARD_FROM", {"cpu": hard_from})
        found.append(simulate(blade, Fem(fineness=0.5, elements_max=2500)))
    by_columns, by_grids = found
    assert by_grids.quality.cg.sum() < 0.25 * by_columns.quality.cg.sum()
    np.testing.assert_allclose(by_grids.force[-1, 2], by_columns.force[-1, 2], rtol=1e-3)
