from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array

from sim.fem.arrays import axpy, blend, copy_active, extrapolate, fill
from sim.fem.balance import LANES, RUN, SUMS, TOTALS, push_kernel, reduce_kernel, residual_kernel
from sim.scalars import vector_of

MESHES = oracle.domed_meshes()
# Their topology is the same.
MESH = MESHES[0]
VARIANT = [1, 0, 1]
MASS = np.stack([MESHES[variant].node_volume for variant in VARIANT])[:, :, None]
COUNT = len(MESH.nodes)
RUNS = -(-COUNT // RUN)
REALS = [
    pytest.param(wp.float64, 1e-12, id="float64"),
    pytest.param(wp.float32, 1e-5, id="float32"),
]
ACTIVE = np.array([1, 0, 1])


def _random(*shape: int) -> Array:
    return np.random.default_rng(sum(shape)).normal(0, 1, shape)


def _touched() -> Array:
    return np.random.default_rng(12).integers(0, 2, (3, len(MESH.faces)))


def _inputs(real: Any, touched: Array, forces: Array) -> list[Any]:
    """Return the structs of meshes and of contact with the faces' forces."""
    contact = oracle.contact_of(
        real, touched=oracle.integers(touched), force=oracle.vectors(forces, real)
    )
    return [oracle.on_device(MESHES, VARIANT, real), contact]


def _at_nodes(cells: Array, values: Array) -> Array:
    return np.stack([oracle.at_nodes(cells, one, COUNT) for one in values])


@pytest.mark.parametrize("inertia", [False, True])
@pytest.mark.parametrize("gravity", [False, True])
@pytest.mark.parametrize(("real", "error"), REALS)
@pytest.mark.parametrize("lanes", [1, LANES])
def test_residual_gathers_every_share_once_and_the_sums_are_numpys(
    monkeypatch: pytest.MonkeyPatch,
    lanes: int,
    real: Any,
    error: float,
    gravity: bool,
    inertia: bool,
) -> None:
    """By one thread for many nodes, and by blocks of threads as on a GPU."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", lanes > 1)
    elements, faces = _random(3, len(MESH.elements), 8, 3), _random(3, len(MESH.faces), 4, 3)
    u, direction, predicted = _random(3, COUNT, 3), _random(3, COUNT, 3) + 1, _random(3, COUNT, 3)
    rate, weight = np.array([3.0, 5.0, 7.0]), _random(3, 3)
    stiffer, before = np.array([0.5, 2.0, 1.5]), _random(3, COUNT, 3)
    det, touched = _random(3, len(MESH.elements)), _touched()
    residual = oracle.zeros((3, COUNT), vector_of(real))
    runs = RUNS if lanes == 1 else -(-COUNT // lanes)
    sums = oracle.zeros((3, runs, SUMS), wp.float64)
    inputs = [
        *_inputs(real, touched, faces),
        oracle.scalars(rate, real),
        oracle.vectors(predicted, real),
        oracle.scalars(stiffer, real),
        oracle.vectors(before, real),
        oracle.vectors(weight, real),
        oracle.integers(ACTIVE),
        oracle.vectors(elements, real),
        oracle.scalars(det, real),
        oracle.vectors(u, real),
        oracle.vectors(direction, real),
    ]
    kernel = residual_kernel(real, inertia, gravity, lanes=lanes)
    of_elements = oracle.zeros((3, COUNT), vector_of(real))
    dim, out = (3, runs * lanes), [of_elements, residual, sums]
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=out, device="cpu", block_dim=LANES)
    running = ACTIVE[:, None]
    applied = _at_nodes(MESH.faces, faces * touched[:, :, None, None]) * running[..., None]
    pushed = applied.sum(1)
    inner = _at_nodes(MESH.elements, elements) * running[..., None]
    if gravity:
        applied = applied + weight[:, None] * MASS * running[..., None]
    if inertia:
        assert oracle.relative(of_elements.numpy(), inner) < error
        inner = inner + stiffer[:, None, None] * (inner - before) * running[..., None]
        inner = inner + rate[:, None, None] * MASS * (u - predicted) * running[..., None]
    held = ((inner - applied) * ~MESH.free[:, None]).sum(1)
    expected = (applied - inner) * MESH.free[:, None]
    assert oracle.relative(residual.numpy(), expected) < error
    totals = _reduced(sums, lanes).view(TOTALS)[:, 0]
    square, applied_square = (
        ((each * MESH.free[:, None]) ** 2).sum((1, 2)) for each in (expected, applied)
    )
    assert oracle.relative(totals["square"], square) < error
    assert oracle.relative(totals["applied"], applied_square) < error
    assert oracle.relative(totals["slope"], -(expected * direction).sum((1, 2))) < error
    assert oracle.relative(totals["det"], det.min(1) * ACTIVE) < error
    assert oracle.relative(totals["contact"], pushed) < error
    assert oracle.relative(totals["base"], held) < error


def _reduced(sums: Any, lanes: int = 1) -> Array:
    totals = oracle.zeros((3, SUMS), wp.float64)
    kernel, dim, inputs = (
        reduce_kernel(lanes=lanes),
        (3, SUMS, lanes),
        [oracle.integers(ACTIVE), sums],
    )
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=[totals], device="cpu", block_dim=LANES)
    return np.asarray(totals.numpy())


def test_a_run_knows_the_least_determinant_around_its_own_nodes() -> None:
    """So that every element is checked, whichever run its nodes belong to."""
    runs = np.arange(COUNT) // RUN
    for element in (0, len(MESH.elements) // 2, len(MESH.elements) - 1):
        det = np.ones((3, len(MESH.elements)))
        det[:, element] = -0.25
        residual = oracle.zeros((3, COUNT), vector_of(wp.float64))
        sums = oracle.zeros((3, RUNS, SUMS), wp.float64)
        nothing = np.zeros((3, COUNT, 3))
        inputs = [
            *_inputs(
                wp.float64, np.zeros((3, len(MESH.faces))), np.zeros((3, len(MESH.faces), 4, 3))
            ),
            oracle.scalars(np.zeros(0), wp.float64),
            empty := oracle.vectors(np.zeros((0, 0, 3)), wp.float64),
            oracle.scalars(np.zeros(0), wp.float64),
            empty,
            oracle.vectors(np.zeros((0, 3)), wp.float64),
            oracle.integers(ACTIVE),
            oracle.vectors(np.zeros((3, len(MESH.elements), 8, 3)), wp.float64),
            oracle.scalars(det, wp.float64),
            oracle.vectors(nothing, wp.float64),
            oracle.vectors(nothing, wp.float64),
        ]
        kernel = residual_kernel(wp.float64, False, False)
        wp.launch(
            kernel, dim=(3, RUNS), inputs=inputs, outputs=[empty, residual, sums], device="cpu"
        )
        expected = np.ones(RUNS)
        expected[runs[MESH.elements[element]]] = -0.25
        np.testing.assert_array_equal(sums.numpy()[0, :, 3], expected)
        assert _reduced(sums)[:, 3].tolist() == [-0.25, 0.0, -0.25]


@pytest.mark.parametrize(("real", "error"), REALS)
def test_push_gathers_the_touched_faces_at_nodes_that_move(real: Any, error: float) -> None:
    faces, touched = _random(3, len(MESH.faces), 4, 3), _touched()
    before = _random(3, COUNT, 3)
    pushed = oracle.vectors(before, real)
    inputs = [*_inputs(real, touched, faces), oracle.integers(ACTIVE)]
    wp.launch(push_kernel(real), dim=(3, COUNT), inputs=inputs, outputs=[pushed], device="cpu")
    expected = _at_nodes(MESH.faces, faces * touched[:, :, None, None]) * MESH.free[:, None]
    expected = np.where(ACTIVE[:, None, None] > 0, expected, before)
    assert oracle.relative(pushed.numpy(), expected) < error


def test_reduce_adds_the_runs_of_active_environments_and_takes_the_least_determinant() -> None:
    partial = _random(3, 7, SUMS)
    expected = partial.sum(1)
    expected[:, 3] = partial[:, :, 3].min(1)
    found = _reduced(wp.array(partial, dtype=wp.float64, device="cpu"))
    np.testing.assert_allclose(found, expected * ACTIVE[:, None], rtol=1e-13)


@pytest.mark.parametrize("real", [wp.float64, wp.float32])
def test_vector_operations_touch_active_environments_only(real: Any) -> None:
    before, now, direction = _random(3, 5, 3), _random(3, 6, 3)[:, :5], _random(3, 7, 3)[:, :5]
    active = oracle.integers(ACTIVE)
    kept = np.where(ACTIVE[:, None, None] > 0, now, before)

    target = oracle.vectors(before, real)
    copy_active(active, oracle.vectors(now, real), target)
    np.testing.assert_allclose(target.numpy(), kept, rtol=1e-6)

    lengths = np.array([0.5, 2.0, 1.0])
    target = oracle.vectors(before, real)
    axpy(
        active,
        oracle.scalars(lengths, real),
        oracle.vectors(now, real),
        oracle.vectors(direction, real),
        target,
    )
    stepped = now + lengths[:, None, None] * direction
    expected = np.where(ACTIVE[:, None, None] > 0, stepped, before)
    np.testing.assert_allclose(target.numpy(), expected, rtol=1e-5, atol=1e-6)

    target = oracle.vectors(direction, real)
    old, new = oracle.vectors(before, real), oracle.vectors(now, real)
    extrapolate(active, oracle.scalars(lengths, real), new, old, target)
    ahead = now + lengths[:, None, None] * (now - before)
    expected = np.where(ACTIVE[:, None, None] > 0, ahead, direction)
    np.testing.assert_allclose(target.numpy(), expected, rtol=1e-5, atol=1e-6)

    target = oracle.vectors(before, real)
    fill(active, oracle.vectors(now[:, 0], real), target)
    expected = np.where(ACTIVE[:, None, None] > 0, now[:, :1], before)
    np.testing.assert_allclose(target.numpy(), expected, rtol=1e-6)

    target = oracle.scalars(before, real)
    blend(active, 0.25, oracle.scalars(now, real), target)
    expected = np.where(ACTIVE[:, None, None] > 0, 0.75 * before + 0.25 * now, before)
    np.testing.assert_allclose(target.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_copies_reach_every_entry_of_a_third_dimension() -> None:
    source = wp.array(_random(3, 4, 6), dtype=wp.float64, device="cpu")
    target = oracle.zeros((3, 4, 6), wp.float64)
    copy_active(oracle.integers(ACTIVE), source, target)
    np.testing.assert_array_equal(target.numpy(), source.numpy() * ACTIVE[:, None, None])
