"""Patch tests of the assembled equations: uniform deformation, and internal consistency."""

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.closed_forms import confined_stress, uniaxial_stress
from support.fem_oracles import Array

from sim import Body, Effects, Friction, Gravity, Indenter, Inertia, Scene, Viscosity, press
from sim.fem import Fem
from sim.fem.assembly import Assembly
from sim.fem.mesh import Mesh, build_mesh
from sim.indenters import plane, sphere

BODY = Body(size_x=4e-3, size_y=5e-3, thickness=3e-3, poisson=0.4)
AREA = BODY.size_x * BODY.size_y / BODY.thickness**2
MATERIAL = oracle.Material(BODY.shear_modulus / BODY.modulus, BODY.bulk_modulus / BODY.modulus)


def _mesh() -> Mesh:
    """Return a mesh with displaced inner nodes, on which a patch test must not depend."""
    mesh = build_mesh(BODY, 1e-3)
    moved = oracle.moved(mesh, 0.05)
    outer = np.unique(mesh.faces)
    nodes = moved.nodes.copy()
    nodes[outer] = mesh.nodes[outer]
    return oracle.with_nodes(mesh, nodes)


def _assembly(mesh: Mesh, scene: Scene) -> Assembly:
    return Assembly([mesh], [scene], Fem(), "float64", "cpu")


def _strained(deformation: Array) -> tuple[Array, Array]:
    """Return residual (N, 3) and base reaction (3,) [moduli, thicknesses] under uniform F."""
    mesh = _mesh()
    assembly = _assembly(mesh, Scene(plane(), press([1e-4]), BODY))
    height = mesh.nodes + np.array([0, 0, 1])
    u = height @ np.asarray(deformation).T - height
    state = assembly.state
    state.contact.tip.assign(np.array([[0.0, 0.0, 5.0]]))
    state.u.assign(u[None])
    sums = assembly.evaluate(state.everyone, state.u, wp.zeros_like(assembly.residual))
    assert not sums["contact"].any()
    assert sums["det"][0] == pytest.approx(np.linalg.det(deformation))
    return assembly.residual.numpy()[0], sums["base"][0]


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
    # Lateral stretch q at which the sides are traction-free: from P = G J^(-5/3) (s^2 - q^2) q^2.
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
    # The volume stays, so P = G (F - tr(F^T F)/3 F^-T) for F = 1 + g e_x e_z.
    shear = BODY.shear_modulus / BODY.modulus
    along, normal = shear * amount, -shear * amount**2 / 3
    assert reaction == pytest.approx([-along * AREA, 0, -normal * AREA], rel=1e-7, abs=1e-9)


ALL = Effects(
    friction=Friction(0.4),
    viscosity=Viscosity((0.5,), (0.1,)),
    inertia=Inertia(),
    gravity=Gravity(),
)


# The curvature of a sphere's normal is measured over a short distance; its effect on the shear
# traction is omitted from the tangent to keep it symmetric. A plane's normal is constant.
@pytest.mark.parametrize(
    ("indenter", "effects", "error"),
    [
        (sphere(2e-3), Effects(), 1e-5),
        (sphere(2e-3), ALL, 6e-2),
        (plane(), Effects(), 1e-6),
        (plane(), ALL, 1e-6),
    ],
    ids=["sphere", "sphere, all effects", "plane", "plane, all effects"],
)
def test_the_tangent_is_the_derivative_of_the_residual(
    indenter: Indenter, effects: Effects, error: float
) -> None:
    """For the whole assembly, with all constraints, and the indenter pressed in."""
    mesh = _mesh()
    scene = Scene(indenter, press([1e-4]), BODY, effects)
    assembly = _assembly(mesh, scene)
    state, everyone = assembly.state, assembly.state.everyone
    _begin(assembly, np.array([[0.02, 0.01, -0.1]]))
    random = np.random.default_rng(7)
    u, v = random.normal(0, 0.005, (2, 1, *mesh.nodes.shape)) * mesh.free[:, None]
    _residual(assembly, u)
    if effects.friction is not None:
        state.settle_limit(everyone)
    step = 1e-7
    slope = _residual(assembly, u + step * v) - _residual(assembly, u - step * v)
    slope /= 2 * step
    _residual(assembly, u)
    assembly.linearise(everyone, state.u, np.zeros(1))
    product = wp.zeros_like(assembly.residual)
    sums = wp.zeros((1, assembly.block_matrix.parts, 1), dtype=wp.float64, device="cpu")
    assembly.block_matrix.product(oracle.rows([1]), oracle.vectors(v, wp.float64), product, sums)
    found = -product.numpy()
    assert not slope[:, ~mesh.free].any()
    assert np.linalg.norm(found - slope) < error * np.linalg.norm(slope)
    assert sums.numpy().sum() == pytest.approx((product.numpy() * v).sum(), rel=1e-10)


def _begin(assembly: Assembly, tip: Array) -> None:
    """Set every tip (B, 3) to its position at the end of a step of 0.3 ms."""
    everyone = np.ones(len(tip), bool)
    nothing = np.zeros(len(tip))
    assembly.state.begin_step(everyone, tip, np.full(len(tip), 3e-4), nothing)
    assembly.state.set_tip(everyone)


def _residual(assembly: Assembly, u: Array) -> Array:
    state = assembly.state
    state.u.assign(u)
    assembly.evaluate(state.everyone, state.u, wp.zeros_like(assembly.residual))
    return np.asarray(assembly.residual.numpy().copy())


@pytest.mark.parametrize(
    ("indenter", "friction", "error"),
    [(sphere(2e-3), None, 1e-4), (plane(), Friction(0.4), 1e-7)],
    ids=["sphere", "plane with friction"],
)
def test_push_is_the_derivative_of_the_nodal_forces_with_the_tip(
    indenter: Indenter, friction: Friction | None, error: float
) -> None:
    """Sideways and down, with multipliers; an inactive environment keeps its previous values."""
    scene = Scene(indenter, press([1e-4]), BODY, Effects(friction=friction))
    assembly = Assembly([_mesh()] * 2, [scene] * 2, Fem(), "float64", "cpu")
    state = assembly.state
    tip = np.array([[0.02, 0.01, -0.1], [0.0, 0.0, -0.05]])
    random = np.random.default_rng(5)
    free = assembly.mesh.free[:, None]
    u = random.normal(0, 0.005, (2, *assembly.mesh.nodes.shape)) * free
    state.contact.multiplier.assign(random.uniform(0, 2, state.contact.multiplier.shape))
    _begin(assembly, tip)
    _residual(assembly, u)
    if friction is not None:
        state.settle_limit(state.everyone)
    travel = np.array([[0.3, -0.2, -1.0], [0.1, 0.4, -0.5]])
    step = 1e-7

    def at(fraction: float) -> Array:
        state.contact.tip.assign(tip + fraction * step * travel)
        return _residual(assembly, u)

    slope = (at(1.0) - at(-1.0)) / (2 * step)
    before = at(0.0)
    first = oracle.integers([1, 0])
    assembly.push(first, oracle.vectors(travel, wp.float64))
    pushed = assembly.residual.numpy()
    assert oracle.relative(pushed[0], slope[0]) < error
    np.testing.assert_array_equal(pushed[1], before[1])
    assert pushed[0].sum(0)[2] < 0, "an indenter that goes down presses down"


def test_environments_on_two_graded_meshes_get_in_a_batch_what_they_get_alone() -> None:
    """Compare residual, sums, tangent and push bitwise, on meshes of the same topology."""
    body = Body(size_x=8e-3, size_y=7e-3, thickness=3e-3)
    windows = (((-1e-3, 1e-3), (-1e-3, 1e-3)), ((0.5e-3, 2.5e-3), (-2e-3, 0.0)))
    meshes = [build_mesh(body, 0.6e-3, window) for window in windows]
    assert meshes[0].cells == meshes[1].cells
    assert not np.array_equal(meshes[0].nodes, meshes[1].nodes)
    scenes = [Scene(sphere(radius), press([1e-4]), body) for radius in (2e-3, 3e-3)]
    tip = np.array([[0.0, 0.0, -0.1], [0.5, -1 / 3, -0.15]])
    travel = np.array([[0.0, 0.0, -0.1], [0.2, 0.0, -0.1]])
    u = np.random.default_rng(3).normal(0, 0.003, (2, *meshes[0].nodes.shape))
    u *= meshes[0].free[:, None]

    def answers(chosen: list[int]) -> list[Array]:
        assembly = Assembly(
            [meshes[i] for i in chosen], [scenes[i] for i in chosen], Fem(), "float64", "cpu"
        )
        everyone = assembly.state.everyone
        _begin(assembly, tip[chosen])
        residual = _residual(assembly, u[chosen])
        totals = assembly.sums.copy()
        assembly.linearise(everyone, assembly.state.u, np.zeros(len(chosen)))
        assembly.push(everyone, oracle.vectors(travel[chosen], wp.float64))
        pushed = assembly.residual.numpy()
        return [residual, totals, np.asarray(assembly.block_matrix.matrix.numpy()), pushed]

    batched = answers([0, 1])
    assert (np.abs(batched[1]["contact"][:, 2]) > 0).all(), "both are pressed"
    for env in (0, 1):
        for one, two in zip(batched, answers([env]), strict=True):
            np.testing.assert_array_equal(one[env], two[0])
