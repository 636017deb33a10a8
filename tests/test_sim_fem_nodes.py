from __future__ import annotations

from typing import Any

import fem_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fem_oracles import Array, Material

from sim.fem.nodes import RUN, jacobi_kernel, reduce_kernel, residual_kernel, tangent_kernel
from sim.fem.rest_blocks import rest_blocks
from sim.fem.scalars import matrix_of, vector_of
from sim.fem.vectors import copy_active, extrapolate, walk

MESH = oracle.domed_mesh()
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


def _mesh_inputs(real: Any) -> list[Any]:
    return [
        oracle.integers(MESH.node_elements),
        oracle.integers(MESH.node_faces),
        oracle.integers(MESH.free),
        oracle.scalars(MESH.node_volume, real),
    ]


def _at_nodes(cells: Array, values: Array) -> Array:
    return np.stack([oracle.at_nodes(cells, one, COUNT) for one in values])


@pytest.mark.parametrize("inertia", [False, True])
@pytest.mark.parametrize("gravity", [False, True])
@pytest.mark.parametrize(("real", "error"), REALS)
def test_residual_gathers_every_share_once(
    real: Any, error: float, gravity: bool, inertia: bool
) -> None:
    elements, faces = _random(3, len(MESH.elements), 8, 3), _random(3, len(MESH.faces), 4, 3)
    u, direction, predicted = _random(3, COUNT, 3), _random(3, COUNT, 3) + 1, _random(3, COUNT, 3)
    rate, weight = np.array([3.0, 5.0, 7.0]), _random(3, 3)
    touched = _touched()
    residual = oracle.zeros((3, COUNT), vector_of(real))
    sums = oracle.zeros((3, RUNS, 3), wp.float64)
    inputs = [
        *_mesh_inputs(real),
        oracle.scalars(rate, real),
        oracle.vectors(predicted, real),
        oracle.vectors(weight, real),
        oracle.integers(ACTIVE),
        oracle.vectors(elements, real),
        oracle.integers(touched),
        oracle.vectors(faces, real),
        oracle.vectors(u, real),
        oracle.vectors(direction, real),
    ]
    kernel = residual_kernel(real, inertia, gravity)
    wp.launch(kernel, dim=(3, RUNS), inputs=inputs, outputs=[residual, sums], device="cpu")
    applied = _at_nodes(MESH.faces, faces * touched[:, :, None, None])
    inner = _at_nodes(MESH.elements, elements)
    mass = MESH.node_volume[None, :, None]
    if gravity:
        applied = applied + weight[:, None] * mass
    if inertia:
        inner = inner + rate[:, None, None] * mass * (u - predicted)
    expected = (applied - inner) * MESH.free[:, None] * ACTIVE[:, None, None]
    assert oracle.relative(residual.numpy(), expected) < error
    applied = applied * MESH.free[:, None] * ACTIVE[:, None, None]
    totals = np.stack(
        [
            (expected**2).sum((1, 2)),
            (applied**2).sum((1, 2)),
            -(expected * direction).sum((1, 2)),
        ],
        axis=1,
    )
    assert oracle.relative(sums.numpy().sum(1), totals) < error


@pytest.mark.parametrize(("real", "error"), REALS)
def test_tangent_product_gathers_every_share_once(real: Any, error: float) -> None:
    elements, faces = _random(3, len(MESH.elements), 8, 3), _random(3, len(MESH.faces), 4, 3)
    v, shift, touched = _random(3, COUNT, 3), np.array([0.0, 2.0, 4.0]), _touched()
    product = oracle.zeros((3, COUNT), vector_of(real))
    sums = oracle.zeros((3, RUNS, 3), wp.float64)
    inputs = [
        *_mesh_inputs(real),
        oracle.scalars(shift, real),
        oracle.integers(ACTIVE),
        oracle.vectors(elements, real),
        oracle.integers(touched),
        oracle.vectors(faces, real),
        oracle.vectors(v, real),
    ]
    outputs = [product, sums]
    wp.launch(tangent_kernel(real), dim=(3, RUNS), inputs=inputs, outputs=outputs, device="cpu")
    total = _at_nodes(MESH.elements, elements)
    total += _at_nodes(MESH.faces, faces * touched[:, :, None, None])
    total += v * shift[:, None, None] * MESH.node_volume[None, :, None]
    expected = total * MESH.free[:, None] * ACTIVE[:, None, None]
    assert oracle.relative(product.numpy(), expected) < error
    curvature = (expected * v).sum((1, 2))
    assert oracle.relative(sums.numpy()[:, :, 0].sum(1), curvature) < error


def test_reduce_adds_the_runs_of_active_environments() -> None:
    partial = _random(3, 7, 3)
    totals = oracle.zeros((3, 3), wp.float64)
    inputs = [oracle.integers(ACTIVE), wp.array(partial, dtype=wp.float64, device="cpu")]
    wp.launch(reduce_kernel(), dim=(3, 3), inputs=inputs, outputs=[totals], device="cpu")
    np.testing.assert_allclose(totals.numpy(), partial.sum(1) * ACTIVE[:, None], rtol=1e-14)


def test_rest_blocks_are_the_diagonal_of_the_undeformed_stiffness() -> None:
    rest = np.zeros((COUNT, 3))
    shear_block, bulk_block = rest_blocks(MESH)
    for block, material in ((shear_block, Material(1.0, 0.0)), (bulk_block, Material(0.0, 1.0))):
        dense = oracle.stiffness(MESH, rest, material)
        expected = np.einsum("ninj->nij", dense)
        assert oracle.relative(block, expected) < 1e-12


@pytest.mark.parametrize(("real", "error"), REALS)
def test_jacobi_inverts_the_diagonal_blocks(real: Any, error: float) -> None:
    shear_block, bulk_block = rest_blocks(MESH)
    shear, bulk = np.array([0.3, 0.4, 0.5]), np.array([3.0, 2.0, 1.0])
    factor, bulk_factor = np.array([1.0, 1.5, 2.0]), np.array([1.0, 1.2, 1.4])
    shift, touched = np.array([0.0, 10.0, 20.0]), _touched()
    root = _random(3, len(MESH.faces), 4, 3, 3)
    faces = root @ np.swapaxes(root, 3, 4)
    inverse = oracle.zeros((3, COUNT), matrix_of(real))
    inputs = [
        oracle.integers(MESH.node_faces),
        oracle.integers(MESH.free),
        oracle.scalars(MESH.node_volume, real),
        oracle.matrices(shear_block, real),
        oracle.matrices(bulk_block, real),
        *(oracle.scalars(one, real) for one in (shear, bulk, factor, bulk_factor, shift)),
        oracle.integers(ACTIVE),
        oracle.integers(touched),
        oracle.matrices(faces, real),
    ]
    kernel = jacobi_kernel(real)
    wp.launch(kernel, dim=(3, COUNT), inputs=inputs, outputs=[inverse], device="cpu")
    blocks = shear_block * (shear * factor)[:, None, None, None]
    blocks = blocks + bulk_block * (bulk * bulk_factor)[:, None, None, None]
    blocks += _at_nodes(MESH.faces, faces * touched[:, :, None, None, None])
    blocks += np.eye(3) * (shift[:, None, None] * MESH.node_volume[None, :, None])[..., None]
    expected = np.linalg.inv(blocks) * MESH.free[:, None, None] * ACTIVE[:, None, None, None]
    assert oracle.relative(inverse.numpy(), expected) < 10 * error


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
    walk(
        active,
        oracle.scalars(lengths, real),
        oracle.vectors(now, real),
        oracle.vectors(direction, real),
        target,
    )
    stepped = now + lengths[:, None, None] * direction
    expected = np.where(ACTIVE[:, None, None] > 0, stepped, before)
    np.testing.assert_allclose(target.numpy(), expected, rtol=1e-5, atol=1e-6)

    target = oracle.zeros((3, 5), vector_of(real))
    old, new = oracle.vectors(before, real), oracle.vectors(now, real)
    extrapolate(oracle.scalars(lengths, real), new, old, target)
    expected = now + lengths[:, None, None] * (now - before)
    np.testing.assert_allclose(target.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_copies_reach_every_entry_of_a_third_dimension() -> None:
    source = wp.array(_random(3, 4, 6), dtype=wp.float64, device="cpu")
    target = oracle.zeros((3, 4, 6), wp.float64)
    copy_active(oracle.integers(ACTIVE), source, target)
    np.testing.assert_array_equal(target.numpy(), source.numpy() * ACTIVE[:, None, None])
