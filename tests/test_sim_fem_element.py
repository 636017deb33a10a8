from __future__ import annotations

from typing import Any

import fem_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fem_oracles import Array, Material

from sim.fem.element import GAUSS_POINTS, element_kernels
from sim.fem.mesh import Mesh
from sim.fem.scalars import vector_of

MESH = oracle.domed_mesh()
PRECISIONS = [
    pytest.param(wp.float64, 1e-12, id="float64"),
    pytest.param(wp.float32, 3e-5, id="float32"),
]
VARIANTS = ["elastic", "viscous", "full_integration"]


def _states(count: int) -> Array:
    """Displacements (B, N, 3) with strains of some 20 %, of the base too."""
    return np.random.default_rng(11).normal(0, 0.02, (count, len(MESH.nodes), 3))


def _materials(variant: str) -> list[Material]:
    random = np.random.default_rng(5)
    materials = []
    for shear, bulk in ((0.345, 3.3), (0.4, 0.5)):
        if variant != "viscous":
            everywhere = variant == "full_integration"
            materials.append(Material(shear, bulk, everywhere=everywhere))
            continue
        history = random.normal(0, 0.1, (len(MESH.elements), GAUSS_POINTS, 3, 3))
        history = history + np.swapaxes(history, 2, 3)
        materials.append(
            Material(
                shear,
                bulk,
                factor=1.6 - shear,
                bulk_factor=1.2 + shear,
                history=history,
                bulk_history=random.normal(0, 0.1, len(MESH.elements)),
            )
        )
    return materials


def _inputs(mesh: Mesh, materials: list[Material], active: Array, u: Array, real: Any) -> list[Any]:
    viscous = materials[0].history is not None
    empty = np.zeros((0, 0, 0, 3, 3)), np.zeros((0, 0))
    history = [one.history for one in materials] if viscous else empty[0]
    bulk_history = [one.bulk_history for one in materials] if viscous else empty[1]
    return [
        oracle.integers(mesh.elements),
        oracle.matrices(mesh.inverse, real),
        oracle.scalars(mesh.weight, real),
        GAUSS_POINTS,
        oracle.scalars([one.shear for one in materials], real),
        oracle.scalars([one.bulk for one in materials], real),
        oracle.scalars([one.factor for one in materials], real),
        oracle.scalars([one.bulk_factor for one in materials], real),
        oracle.matrices(history, real),
        oracle.scalars(bulk_history, real),
        oracle.integers(active),
        oracle.vectors(u, real),
    ]


def _residual(
    materials: list[Material], u: Array, real: Any, variant: str, active: Array | None = None
) -> tuple[Array, Array, Array]:
    kernel = element_kernels(real, variant == "viscous", variant == "full_integration")[0]
    shape = len(u), len(MESH.elements)
    outputs = [
        oracle.zeros((*shape, 8), vector_of(real)),
        oracle.zeros(shape, real),
        oracle.zeros(shape, real),
    ]
    active = np.ones(len(u)) if active is None else active
    inputs = _inputs(MESH, materials, active, u, real)
    wp.launch(kernel, dim=shape, inputs=inputs, outputs=outputs, device="cpu")
    force, energy, det = (output.numpy().astype(float) for output in outputs)
    return force, energy, det


def _tangent(materials: list[Material], u: Array, v: Array, real: Any, variant: str) -> Array:
    kernel = element_kernels(real, variant == "viscous", variant == "full_integration")[1]
    shape = len(u), len(MESH.elements)
    output = oracle.zeros((*shape, 8), vector_of(real))
    inputs = [*_inputs(MESH, materials, np.ones(len(u)), u, real), oracle.vectors(v, real)]
    wp.launch(kernel, dim=shape, inputs=inputs, outputs=[output], device="cpu")
    return np.asarray(output.numpy(), float)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("real", "error"), PRECISIONS)
def test_element_forces_are_those_of_plain_shape_functions(
    real: Any, error: float, variant: str
) -> None:
    materials, u = _materials(variant), _states(2)
    force, _energy, _det = _residual(materials, u, real, variant)
    for env, material in enumerate(materials):
        expected = oracle.element_force(MESH, u[env], material)
        assert oracle.relative(force[env], expected) < error


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("real", "error"), PRECISIONS)
def test_element_tangent_is_the_derivative_of_the_force(
    real: Any, error: float, variant: str
) -> None:
    materials, u = _materials(variant), _states(2)
    v = np.random.default_rng(2).normal(0, 1, u.shape)
    product = _tangent(materials, u, v, real, variant)
    for env, material in enumerate(materials):
        expected = oracle.element_tangent(MESH, u[env], v[env], material)
        assert oracle.relative(product[env], expected) < error


def test_element_force_is_the_slope_of_the_energy_by_central_differences() -> None:
    materials, u = _materials("elastic"), _states(2)
    v = np.random.default_rng(8).normal(0, 1, u.shape)
    force, _energy, _det = _residual(materials, u, wp.float64, "elastic")
    step = 1e-5
    _, ahead, _ = _residual(materials, u + step * v, wp.float64, "elastic")
    _, behind, _ = _residual(materials, u - step * v, wp.float64, "elastic")
    slope = (ahead - behind) / (2 * step)
    expected = np.einsum("beai,beai->be", force, v[:, MESH.elements])
    assert oracle.relative(slope, expected) < 1e-7


@pytest.mark.parametrize(("real", "error"), PRECISIONS)
def test_element_energy_and_least_det_are_the_oracles(real: Any, error: float) -> None:
    materials, u = _materials("elastic"), _states(2)
    _force, energy, det = _residual(materials, u, real, "elastic")
    for env, material in enumerate(materials):
        expected = oracle.element_energy(MESH, u[env], material)
        assert oracle.relative(energy[env], expected) < error
        f, _slopes, _weight = oracle.deformation(MESH, u[env])
        assert oracle.relative(det[env], np.linalg.det(f).min(axis=1)) < error


def test_tangent_is_symmetric_and_knows_no_force_from_rigid_motion() -> None:
    materials, u = _materials("elastic"), _states(2)
    random = np.random.default_rng(4)
    v, w = random.normal(0, 1, (2, *u.shape))
    one = _tangent(materials, u, v, wp.float64, "elastic")
    two = _tangent(materials, u, w, wp.float64, "elastic")
    along = np.einsum("beai,beai->b", one, w[:, MESH.elements])
    across = np.einsum("beai,beai->b", two, v[:, MESH.elements])
    assert along == pytest.approx(across, rel=1e-12)
    angle = 0.7
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    rigid = np.stack([MESH.nodes @ turn.T - MESH.nodes + 0.3] * 2)
    force, energy, det = _residual(materials, rigid, wp.float64, "elastic")
    assert np.abs(force).max() < 1e-14
    assert np.abs(energy).max() < 1e-14
    assert det == pytest.approx(1.0, abs=1e-14)


def test_float32_forces_are_off_by_no_more_than_round_off_of_the_modulus() -> None:
    """2e-7 of shear modulus times face, whatever the strain: what `FORCE_FLOOR` rests on."""
    materials = _materials("elastic")
    for scale in (1.0, 1e-2, 1e-4):
        u = _states(2) * scale
        force, _energy, _det = _residual(materials, u, wp.float32, "elastic")
        for env, material in enumerate(materials):
            expected = oracle.element_force(MESH, u[env], material)
            face = (1e-3 / 3e-3) ** 2
            size = np.abs(expected).max() + material.shear * face
            assert np.abs(force[env] - expected).max() < 2e-7 * size


def test_environments_that_are_not_active_are_left_alone() -> None:
    materials, u = _materials("elastic"), _states(2)
    force, energy, det = _residual(materials, u, wp.float64, "elastic", np.array([0, 1]))
    assert not force[0].any()
    assert not energy[0].any()
    assert not det[0].any()
    assert np.abs(force[1]).max() > 0
