from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array
from support.few import few

from sim.fem.newton import ConjugateGradient

NODES = 40
SIZE = 3 * NODES


def _symmetric(eigenvalues: Array, seed: int) -> Array:
    basis, _ = np.linalg.qr(np.random.default_rng(seed).normal(0, 1, (SIZE, SIZE)))
    return np.asarray((basis * eigenvalues) @ basis.T)


class Dense:
    """Dense matrices, one per environment, in place of the block matrix."""

    parts = 3

    def __init__(self, matrices: Array) -> None:
        self._matrices = matrices

    def product(self, which: Any, v: Any, product: Any, sums: Any) -> None:
        for env in which.numpy()[which.numpy() >= 0]:
            along = v.numpy()[env].astype(float).ravel()
            answer = self._matrices[env] @ along
            product.numpy()[env] = answer.reshape(NODES, 3)
            _share(sums.numpy()[env, :, 0], answer * along)


class Blocks:
    """The inverted diagonal blocks of dense matrices, in place of the column preconditioner."""

    parts = 4
    grids = 1

    def choose(self, _running: Any) -> int:
        return self.grids

    def __init__(self, matrices: Array) -> None:
        blocks = np.einsum("bninj->bnij", matrices.reshape(-1, NODES, 3, NODES, 3))
        self._inverse = np.linalg.inv(blocks)

    def advance(self, which: Any, scalars: Any, along: Any, vectors: Any, sums: Any) -> None:
        p, product = (each.numpy() for each in along)
        solution, r, z = (each.numpy() for each in vectors)
        for env in which.numpy()[which.numpy() >= 0]:
            step = scalars.numpy()[env, 2]
            solution[env] += step * p[env]
            r[env] -= step * product[env]
            z[env] = np.einsum("nij,nj->ni", self._inverse[env], r[env])
            exact = r[env].astype(float)
            _share(sums.numpy()[env, :, 0], (exact * z[env]).ravel())
            _share(sums.numpy()[env, :, 1], (exact**2).ravel())


class Negative(Blocks):
    """A preconditioner that is not positive definite from its second application on."""

    _applied = 0

    def advance(self, which: Any, scalars: Any, along: Any, vectors: Any, sums: Any) -> None:
        super().advance(which, scalars, along, vectors, sums)
        self._applied += 1
        if self._applied > 1:
            sums.numpy()[..., 0] *= -1.0


def _share(sums: Array, terms: Array) -> None:
    """Write the sum of the terms as partial sums that fill the array."""
    sums[:] = [part.sum() for part in np.array_split(terms, len(sums))]


class Solved:
    """Result of the solver for dense systems, one per environment."""

    def __init__(
        self,
        matrices: Array,
        right: Array,
        active: Array,
        accuracy: float,
        real: Any,
        most: int,
        *,
        gather: bool = False,
    ) -> None:
        count = len(matrices)
        # NumPy oracles, which no CUDA graph can record.
        both = Dense(matrices), Blocks(matrices)
        solver = ConjugateGradient(real, count, NODES, "cpu", *both, gather=gather, record=False)
        solver.solve(active > 0, oracle.vectors(right, real), np.full(count, accuracy), most)
        self.solution = solver.solution.numpy().astype(float).reshape(count, SIZE)
        self.count, self.slope, self.concave = solver.status()


def _right(count: int) -> Array:
    return np.random.default_rng(0).normal(0, 1, (count, NODES, 3))


@pytest.mark.parametrize(
    ("real", "accuracy", "error"), [(wp.float64, 1e-12, 1e-9), (wp.float32, 1e-5, 1e-3)]
)
def test_the_solution_is_that_of_a_dense_solve(real: Any, accuracy: float, error: float) -> None:
    matrices = np.stack([_symmetric(np.linspace(1, high, SIZE), high) for high in (5, 50)])
    right = _right(2)
    solved = Solved(matrices, right, np.ones(2), accuracy, real, 400)
    for env in range(2):
        expected = np.linalg.solve(matrices[env], right[env].ravel())
        assert oracle.relative(solved.solution[env], expected) < error
        rest = right[env].ravel() - matrices[env] @ solved.solution[env]
        assert np.linalg.norm(rest) < 2 * accuracy * np.linalg.norm(right[env])
    assert not solved.concave.any()
    assert solved.count[0] < solved.count[1], "the better conditioned system stops first"


def test_a_preconditioner_that_is_not_positive_ends_as_not_convex() -> None:
    """It is made from a tangent that is not convex; the solution before it is kept."""
    matrices = _symmetric(np.linspace(1, 50, SIZE), 1)[None]
    both = Dense(matrices), Negative(matrices)
    solver = ConjugateGradient(wp.float64, 1, NODES, "cpu", *both, record=False)
    right = oracle.vectors(_right(1), wp.float64)
    solver.solve(np.ones(1, bool), right, np.full(1, 1e-9), 400)
    count, slope, concave = solver.status()
    assert count[0] == 1
    assert concave[0]
    assert np.isclose(slope[0], -(_right(1).ravel() @ solver.solution.numpy().ravel()))
    assert slope[0] < 0


@pytest.mark.parametrize(("real", "error"), [(wp.float64, 1e-6), (wp.float32, 1e-4)])
@pytest.mark.parametrize("most", few([7, 1, 400], 1))
def test_the_slope_is_that_of_the_right_hand_side_along_the_solution(
    real: Any, error: float, most: int
) -> None:
    """For solves that were truncated, ended by negative curvature, or reached their accuracy."""
    concave = np.linspace(1, 9, SIZE)
    concave[0] = -5.0
    spread = (np.linspace(1, 5, SIZE), np.geomspace(1, 1e3, SIZE), concave, np.full(SIZE, -1.0))
    matrices = np.stack([_symmetric(values, seed) for seed, values in enumerate(spread)])
    right = _right(len(spread))
    solved = Solved(matrices, right, np.ones(len(spread)), 1e-5, real, most)
    assert max(solved.count) <= most
    expected = -(right.reshape(len(spread), SIZE) * solved.solution).sum(1)
    assert solved.slope == pytest.approx(expected, rel=error)
    # The last one follows the preconditioned right-hand side; its inverse blocks are -1.
    assert (solved.slope[:3] < 0).all()
    assert solved.concave[3]
    assert solved.concave[2] or most < 400


def test_as_many_iterations_as_different_eigenvalues_suffice() -> None:
    """A property of conjugate gradients; preconditioning by a multiple of 1 changes nothing."""
    single = 3.0 * np.eye(SIZE)
    solved = Solved(single[None], _right(1), np.ones(1), 1e-12, wp.float64, 10)
    assert solved.count[0] == 1
    np.testing.assert_allclose(solved.solution[0], _right(1).ravel() / 3, rtol=1e-12)
    # One pair of equal and opposite couplings per node pair: eigenvalues 2 and 4 on unit blocks.
    pairs = np.kron(np.kron(np.eye(NODES // 2), np.array([[3.0, 1.0], [1.0, 3.0]])), np.eye(3))
    solved = Solved(pairs[None], _right(1), np.ones(1), 1e-12, wp.float64, 10)
    assert solved.count[0] == 2


def test_an_environment_that_is_off_costs_nothing_and_a_zero_right_hand_side_ends_at_once() -> None:
    matrices = np.stack([_symmetric(np.linspace(1, 9, SIZE), seed) for seed in (1, 2, 3)])
    right = _right(3)
    right[2] = 0.0
    solved = Solved(matrices, right, np.array([1, 0, 1]), 1e-8, wp.float64, 200)
    assert solved.count[0] > 0
    assert solved.count[1] == solved.count[2] == 0
    assert not solved.solution[1:].any()
    assert solved.slope[0] < 0
    assert solved.slope[2] == 0
    assert not solved.concave.any()


def test_a_batch_gives_each_system_what_it_gets_alone_bit_for_bit() -> None:
    matrices = np.stack([_symmetric(np.linspace(1, high, SIZE), high) for high in (4, 40, 400)])
    right = _right(3)
    batched = Solved(matrices, right, np.ones(3), 1e-10, wp.float64, 400)
    for env in range(3):
        alone = Solved(
            matrices[env : env + 1], right[env : env + 1], np.ones(1), 1e-10, wp.float64, 400
        )
        np.testing.assert_array_equal(alone.solution[0], batched.solution[env])
        assert alone.count[0] == batched.count[env]


def test_a_direction_that_is_not_convex_is_said_and_ends_the_solve() -> None:
    bad = np.linspace(1, 9, SIZE)
    bad[0] = -5.0
    matrices = np.stack([_symmetric(bad, 1), _symmetric(np.linspace(1, 9, SIZE), 2)])
    solved = Solved(matrices, _right(2), np.ones(2), 1e-12, wp.float64, 400)
    assert solved.concave.tolist() == [True, False]
    assert np.isfinite(solved.solution).all()
    assert _right(2)[0].ravel() @ solved.solution[0] > 0, "what was found still leads downhill"


@pytest.mark.slow
def test_rows_that_are_gathered_change_nothing() -> None:
    """Seven systems that end at seven times, one inactive: 8 rows, then 4, 2 and 1."""
    matrices = np.stack([_symmetric(np.geomspace(1, 4**k, SIZE), k) for k in range(1, 9)])
    right, active = _right(8), np.array([1, 1, 1, 0, 1, 1, 1, 1])
    apart, batched = (
        Solved(matrices, right, active, 1e-8, wp.float64, 2000, gather=gather)
        for gather in (False, True)
    )
    assert len(np.unique(apart.count)) > 5
    assert not apart.count[3]
    np.testing.assert_array_equal(apart.count, batched.count)
    np.testing.assert_array_equal(apart.solution, batched.solution)
    np.testing.assert_array_equal(apart.slope, batched.slope)
