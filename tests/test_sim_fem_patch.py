"""Patch tests: what the assembled equations say of even deformation, and of themselves."""

from __future__ import annotations

from dataclasses import replace

import fem_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fem_oracles import Array

from sim import Body, Effects, Friction, Gravity, Inertia, Scene, Viscosity, press
from sim.fem.assembly import Assembly
from sim.fem.mesh import Mesh, build_mesh
from sim.fem.numerics import Numerics
from sim.indenters import plane, sphere
from sim.references import confined_stress, simple_shear_stress, uniaxial_stress

BODY = Body(size_x=4e-3, size_y=5e-3, thickness=3e-3, poisson=0.4)
AREA = BODY.size_x * BODY.size_y / BODY.thickness**2
MATERIAL = oracle.Material(BODY.shear_modulus / BODY.modulus, BODY.bulk_modulus / BODY.modulus)


def _mesh() -> Mesh:
    """Uneven inside, flat outside: even deformation must not see the inner nodes' places."""
    mesh = build_mesh(BODY, 1e-3)
    moved = oracle.moved(mesh, 0.05)
    outer = np.unique(mesh.faces)
    nodes = moved.nodes.copy()
    nodes[outer] = mesh.nodes[outer]
    jacobian = np.einsum("eai,qaj->eqij", nodes[mesh.elements], oracle.local_gradients())
    return replace(
        mesh, nodes=nodes, inverse=np.linalg.inv(jacobian), weight=np.linalg.det(jacobian)
    )


def _assembly(mesh: Mesh, scene: Scene) -> Assembly:
    return Assembly(mesh, [scene], Numerics(), "float64", "cpu")


def _strained(deformation: Array) -> tuple[Array, Array]:
    """Residual (N, 3) and reaction of the base (3,) in moduli and thicknesses, under even F."""
    mesh = _mesh()
    assembly = _assembly(mesh, Scene(plane(), press([1e-4]), BODY))
    height = mesh.nodes + np.array([0, 0, 1])
    u = height @ np.asarray(deformation).T - height
    state = assembly.state
    state.tip.assign(np.array([[0.0, 0.0, 5.0]]))
    state.u.assign(u[None])
    reaction = assembly.reactions()[0]
    return assembly.residual.numpy()[0], reaction


@pytest.mark.parametrize("stretch", [0.7, 0.999, 1.2])
def test_confined_compression_is_even_and_its_base_feels_the_closed_form(stretch: float) -> None:
    residual, reaction = _strained(np.diag([1, 1, stretch]))
    mesh = _mesh()
    inner = np.setdiff1d(np.flatnonzero(mesh.free), np.unique(mesh.faces))
    assert len(inner) > 10
    assert np.abs(residual[inner]).max() < 1e-9 * np.abs(residual).max()
    expected = confined_stress(stretch, 1.0, BODY.poisson) * AREA
    assert reaction == pytest.approx([0, 0, -expected], rel=1e-7, abs=1e-9)


def test_uniaxial_stress_leaves_the_sides_without_force() -> None:
    stretch = 0.8
    stress = uniaxial_stress(stretch, 1.0, BODY.poisson)
    # The side's stretch q at which the sides carry nothing: from P = G J^(-5/3) (s^2 - q^2) q^2.
    q = np.linspace(1.0, 1.3, 200001)
    volume = q**2 * stretch
    found = MATERIAL.shear * volume ** (-5 / 3) * (stretch**2 - q**2) * q**2
    width = float(np.interp(-stress, -found, q))
    mesh = _mesh()
    residual, reaction = _strained(np.diag([width, width, stretch]))
    nx, ny, nz = mesh.cells
    grid = np.arange(len(mesh.nodes)).reshape(nx + 1, ny + 1, nz + 1)
    sides = np.setdiff1d(np.unique(mesh.faces), grid[:, :, [0, -1]].ravel())
    assert np.abs(residual[sides]).max() < 1e-6 * np.abs(residual).max()
    assert reaction[2] == pytest.approx(-stress * AREA, rel=1e-6)


def test_simple_shear_needs_its_normal_stress_too() -> None:
    amount = 0.3
    deformation = np.eye(3)
    deformation[0, 2] = amount
    _residual, reaction = _strained(deformation)
    along, normal = simple_shear_stress(amount, 1.0, BODY.poisson)
    assert reaction == pytest.approx([-along * AREA, 0, -normal * AREA], rel=1e-7, abs=1e-9)


@pytest.mark.parametrize(
    "effects",
    [
        Effects(),
        Effects(
            friction=Friction(0.4),
            viscosity=Viscosity((0.5,), (0.1,)),
            inertia=Inertia(),
            gravity=Gravity(),
        ),
    ],
    ids=["no effects", "all effects"],
)
def test_the_tangent_is_the_derivative_of_the_residual(effects: Effects) -> None:
    """Of the whole assembly, everything held that is held, with the indenter pressed in."""
    mesh = _mesh()
    scene = Scene(sphere(2e-3), press([1e-4]), BODY, effects)
    assembly = _assembly(mesh, scene)
    state, everyone = assembly.state, assembly.state.everyone
    state.begin_step(np.array([[0.02, 0.01, -0.1]]), np.array([3e-4]), np.zeros(1))
    random = np.random.default_rng(7)
    u, v = random.normal(0, 0.005, (2, 1, *mesh.nodes.shape)) * mesh.free[:, None]
    nothing = wp.zeros_like(assembly.residual)

    def residual(displacement: Array) -> Array:
        state.u.assign(displacement)
        assembly.evaluate(everyone, state.u, nothing)
        return assembly.residual.numpy().copy()

    residual(u)
    if effects.friction is not None:
        state.settle_limit(everyone)
    step = 1e-7
    slope = (residual(u + step * v) - residual(u - step * v)) / (2 * step)
    residual(u)
    assembly.linearise(everyone, np.zeros(1))
    product = wp.zeros_like(assembly.residual)
    sums = wp.zeros((1, -(-len(mesh.nodes) // 32), 3), dtype=wp.float64, device="cpu")
    direction = oracle.vectors(v, wp.float64)
    assembly.tangent(state.u)(everyone, direction, product, sums)
    found = -product.numpy()
    assert not slope[:, mesh.base].any()
    # The turning of the normal under a sphere is measured over a short distance; with friction,
    # what it does to the traction is left out of the tangent to keep it symmetric.
    error = 1e-4 if effects.friction is None else 2e-2
    assert np.linalg.norm(found - slope) < error * np.linalg.norm(slope)
    assert sums.numpy()[0, :, 0].sum() == pytest.approx((product.numpy() * v).sum(), rel=1e-10)
