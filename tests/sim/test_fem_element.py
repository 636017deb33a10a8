from importlib import import_module
from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array, Material

from sim.fem.element import GAUSS_POINTS
from sim.fem.lanes import AT_ONCE
from sim.scalars import vector_of

MESHES = oracle.domed_meshes()
# Mesh index of each environment, not in order.
VARIANT = [1, 0]
PLACED = [MESHES[variant] for variant in VARIANT]
ELEMENTS = MESHES[0].elements
NODES = len(MESHES[0].nodes)
PRECISIONS = [
    pytest.param(wp.float64, 1e-12, id="float64"),
    pytest.param(wp.float32, 3e-5, id="float32"),
]
KINDS = ["elastic", "viscous", "stiffening"]


@pytest.fixture(params=["sim.fem.element", "sim.fem.lanes"])
def module(request: pytest.FixtureRequest) -> str:
    """Return the module of the kernel: one element a thread, as on a GPU, or eight."""
    return request.param


def _states(count: int) -> Array:
    """Return displacements (B, N, 3) with strains of about 20 %, also of the base."""
    return np.random.default_rng(11).normal(0, 0.02, (count, NODES, 3))


def _materials(kind: str) -> list[Material]:
    random = np.random.default_rng(5)
    materials = []
    for shear, bulk in ((0.345, 3.3), (0.4, 0.5)):
        if kind != "viscous":
            materials.append(Material(shear, bulk, stiffening=5.0 * (kind == "stiffening")))
            continue
        history = random.normal(0, 0.1, (len(ELEMENTS), GAUSS_POINTS, 3, 3))
        history = history + np.swapaxes(history, 2, 3)
        materials.append(
            Material(
                shear,
                bulk,
                factor=1.6 - shear,
                bulk_factor=1.2 + shear,
                history=history,
                bulk_history=random.normal(0, 0.1, len(ELEMENTS)),
            )
        )
    return materials


def _inputs(
    materials: list[Material], active: Array, u: Array, real: Any, variant: list[int]
) -> list[Any]:
    return [
        oracle.on_device(MESHES, variant, real),
        oracle.material_of(materials, real),
        oracle.integers(active),
        oracle.vectors(u, real),
    ]


def _residual(
    module: str,
    materials: list[Material],
    u: Array,
    real: Any,
    kind: str,
    active: Array | None = None,
    variant: list[int] = VARIANT,
) -> tuple[Array, Array, Array]:
    active = np.ones(len(u)) if active is None else active
    inputs = _inputs(materials, active, u, real, variant)
    return _launched(module, kind, real, inputs, (len(u), len(ELEMENTS)))


def _launched(
    module: str, kind: str, real: Any, inputs: list[Any], shape: tuple[int, int]
) -> tuple[Array, Array, Array]:
    of = import_module(module)
    eight = module == "sim.fem.lanes"
    factory = of.forces_kernel if eight else of.element_kernels
    kernel = factory(real, kind == "viscous", stiffening=kind == "stiffening")
    threads = shape[0], -(-shape[1] // (AT_ONCE if eight else 1))
    outputs = [
        oracle.zeros((*shape, 8), vector_of(real)),
        oracle.zeros(shape, real),
        oracle.zeros(shape, real),
    ]
    wp.launch(kernel, dim=threads, inputs=inputs, outputs=outputs, device="cpu")
    force, energy, det = (output.numpy().astype(float) for output in outputs)
    return force, energy, det


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("real", "error"), PRECISIONS)
def test_forces_energies_and_least_dets_are_those_of_plain_shape_functions(
    module: str, real: Any, error: float, kind: str
) -> None:
    materials, u = _materials(kind), _states(2) * (2 if kind == "stiffening" else 1)
    force, energy, det = _residual(module, materials, u, real, kind)
    for env, material in enumerate(materials):
        expected = oracle.element_force(PLACED[env], u[env], material)
        assert oracle.relative(force[env], expected) < error
        f, _slopes, _weight = oracle.deformation(PLACED[env], u[env])
        assert oracle.relative(det[env], np.linalg.det(f).min(axis=1)) < error
        if kind != "viscous":
            expected = oracle.element_energy(PLACED[env], u[env], material)
            assert oracle.relative(energy[env], expected) < error


def test_element_force_is_the_slope_of_the_energy_by_central_differences(module: str) -> None:
    materials, u = _materials("stiffening"), 2 * _states(2)
    v = np.random.default_rng(8).normal(0, 1, u.shape)
    force, _energy, _det = _residual(module, materials, u, wp.float64, "stiffening")
    step = 1e-5
    _, ahead, _ = _residual(module, materials, u + step * v, wp.float64, "stiffening")
    _, behind, _ = _residual(module, materials, u - step * v, wp.float64, "stiffening")
    slope = (ahead - behind) / (2 * step)
    assert oracle.relative(slope, np.einsum("beai,beai->be", force, v[:, ELEMENTS])) < 1e-7


def test_rigid_motion_has_no_force_and_no_energy(module: str) -> None:
    materials = _materials("elastic")
    angle = 0.7
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    rigid = np.stack([mesh.nodes @ turn.T - mesh.nodes + 0.3 for mesh in PLACED])
    force, energy, det = _residual(module, materials, rigid, wp.float64, "elastic")
    assert np.abs(force).max() < 1e-14
    assert np.abs(energy).max() < 1e-14
    assert det == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_an_environment_gets_in_a_batch_of_two_meshes_what_it_gets_alone(
    module: str, kind: str
) -> None:
    """Bitwise; on the other mesh the result differs."""
    materials, u = _materials(kind), _states(2)
    batched = _residual(module, materials, u, wp.float64, kind)
    for env in range(2):
        of = slice(env, env + 1)
        for variant in (0, 1):
            alone = _residual(module, materials[of], u[of], wp.float64, kind, variant=[variant])
            for one, two in zip(batched, alone, strict=True):
                assert np.array_equal(one[env], two[0]) == (variant == VARIANT[env])


def test_float32_forces_are_off_by_no_more_than_round_off_of_the_modulus(module: str) -> None:
    """2e-7 of shear modulus times face area at any strain: the basis of `MIN_FORCE_SCALE`."""
    materials = _materials("elastic")
    for scale in (1.0, 1e-2, 1e-4):
        u = _states(2) * scale
        force, _energy, _det = _residual(module, materials, u, wp.float32, "elastic")
        for env, material in enumerate(materials):
            expected = oracle.element_force(PLACED[env], u[env], material)
            face = (1e-3 / 3e-3) ** 2
            size = np.abs(expected).max() + material.shear * face
            assert np.abs(force[env] - expected).max() < 2e-7 * size


def test_a_group_may_lack_elements_and_those_without_weight_are_left_alone(module: str) -> None:
    """As outside a round body, and at the end of a mesh; the others get the same bits."""
    few = AT_ONCE * 2 + 3
    materials, u = _materials("elastic"), _states(2)
    whole = _residual(module, materials, u, wp.float64, "elastic")
    kept = np.ones(few, bool)
    kept[[0, AT_ONCE + 1, few - 1]] = False
    inputs = _inputs(materials, np.ones(2), u, wp.float64, VARIANT)
    mesh = inputs[0]
    weight = mesh.weight.numpy()[:, :few] * kept[:, None]
    mesh.elements = oracle.integers(ELEMENTS[:few])
    mesh.inverse = oracle.matrices(mesh.inverse.numpy()[:, :few], wp.float64)
    mesh.weight = oracle.scalars(weight, wp.float64)
    part = _launched(module, "elastic", wp.float64, inputs, (2, few))
    for one, two in zip(part, whole, strict=True):
        assert np.array_equal(one[:, kept], two[:, :few][:, kept])
        assert not one[:, ~kept].any()


def test_environments_that_are_not_active_are_left_alone(module: str) -> None:
    materials, u = _materials("elastic"), _states(2)
    force, energy, det = _residual(module, materials, u, wp.float64, "elastic", np.array([0, 1]))
    assert not force[0].any()
    assert not energy[0].any()
    assert not det[0].any()
    assert np.abs(force[1]).max() > 0
