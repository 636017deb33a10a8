"""NumPy reference of the finite elements, from plain nodal shape functions.

It shares only the energy with the kernels: forces are computed node by node, and
derivatives by the complex step f'(u) v = Im f(u + i h v) / h, exact to round-off.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim import Body, Indenter
from sim.fem.arrays import contact_struct, material_struct, mesh_on
from sim.fem.contact import face_rule
from sim.fem.mesh import Mesh, build_mesh
from sim.scalars import matrix_of, numpy_of, vector_of

Array = NDArray[Any]

STEP = 1e-30
POINTS = 8
CPU = "cpu"


def domed_mesh() -> Mesh:
    """Return 48 elements of different shapes: a small dome with nodes above the base moved."""
    body = Body(size_x=4e-3, size_y=4.4e-3, thickness=3e-3, dome_radius=5e-3)
    return moved(build_mesh(body, 1e-3), 0.03)


def domed_meshes() -> list[Mesh]:
    """Return `domed_mesh` and a mesh of equal topology, but different nodes, volumes, areas."""
    body = Body(size_x=4.3e-3, size_y=3.9e-3, thickness=3e-3, dome_radius=7e-3)
    return [domed_mesh(), moved(build_mesh(body, 1e-3), 0.02, seed=4)]


def moved(mesh: Mesh, by: float, seed: int = 3) -> Mesh:
    """Return the mesh with its free nodes moved by up to `by` thicknesses, elements updated."""
    shift = np.random.default_rng(seed).uniform(-by, by, mesh.nodes.shape) * mesh.free[:, None]
    return with_nodes(mesh, mesh.nodes + shift)


def with_nodes(mesh: Mesh, nodes: Array) -> Mesh:
    """Return the mesh with moved nodes: elements are updated, faces and masses unchanged."""
    jacobian = np.einsum("eai,qaj->eqij", nodes[mesh.elements], local_gradients())
    return replace(
        mesh, nodes=nodes, inverse=np.linalg.inv(jacobian), weight=np.linalg.det(jacobian)
    )


def local_gradients() -> Array:
    """Return gradients of the 8 trilinear shape functions at 8 Gauss points (point, node, axis).

    N_a = (1 +- xi)(1 +- eta)(1 +- zeta)/8, by the complex step along each axis.
    """
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float)
    gradients = np.empty((POINTS, 8, 3))
    for axis in range(3):
        place = (signs / np.sqrt(3)).astype(complex)
        place[:, axis] += 1j * STEP
        shape = (1 + signs[None] * place[:, None]).prod(axis=2) / 8
        gradients[:, :, axis] = shape.imag / STEP
    return gradients


@dataclass(frozen=True, slots=True)
class Material:
    """One environment's material, and the history of its Prony branches at the step's start."""

    shear: float
    bulk: float
    factor: float = 1.0
    bulk_factor: float = 1.0
    history: Array | None = None
    bulk_history: Array | None = None
    stiffening: float = 0.0


def deformation(mesh: Mesh, u: Array) -> tuple[Array, Array, Array]:
    """Return F (E, 8, 3, 3), d(shape)/dx (E, 8, node, 3) and volume (E, 8) at Gauss points."""
    jacobian = np.einsum("eai,qaj->eqij", mesh.nodes[mesh.elements], local_gradients())
    slopes = np.einsum("qaj,eqji->eqai", local_gradients(), np.linalg.inv(jacobian))
    gradient = np.einsum("eai,eqaj->eqij", u[mesh.elements], slopes)
    return gradient + np.eye(3), slopes, np.linalg.det(jacobian)


def element_energy(mesh: Mesh, u: Array, material: Material) -> Array:
    """Return the elastic energy of every element (E,), real or complex."""
    f, _slopes, weight = deformation(mesh, u)
    j = np.linalg.det(f)
    square = np.einsum("eqij,eqij->eq", f, f)
    invariant = j ** (-2 / 3) * square
    isochoric = material.shear / 2 * (invariant - 3)
    isochoric = isochoric + material.shear / 4 * material.stiffening * _beyond(invariant) ** 2
    volume = weight.sum(1)
    theta = (weight * j).sum(1) / volume
    return (weight * isochoric).sum(1) + volume * material.bulk / 2 * (
        (theta**2 - 1) / 2 - np.log(theta)
    )


def _beyond(invariant: Array) -> Array:
    return np.where(invariant.real > 4.0, invariant - 4.0, 0.0)


def element_force(mesh: Mesh, u: Array, material: Material) -> Array:
    """Return the internal force of every element on its nodes (E, 8, 3), real or complex."""
    f, slopes, weight = deformation(mesh, u)
    j = np.linalg.det(f)
    inverse = np.swapaxes(np.linalg.inv(f), 2, 3)
    square = np.einsum("eqij,eqij->eq", f, f)
    isochoric = material.shear * (j ** (-2 / 3))[..., None, None]
    stiffer = 1 + material.stiffening * _beyond(j ** (-2 / 3) * square)
    isochoric = isochoric * stiffer[..., None, None]
    stress = isochoric * (f - (square / 3)[..., None, None] * inverse) * material.factor
    if material.history is not None:
        stress = stress + f @ material.history
    theta = (weight * j).sum(1) / weight.sum(1)
    average = material.bulk / 2 * (theta - 1 / theta) * material.bulk_factor
    if material.bulk_history is not None:
        average = average + material.bulk_history
    stress = stress + (average[:, None] * j)[..., None, None] * inverse
    return np.einsum("eq,eqij,eqaj->eai", weight, stress, slopes)


def element_tangent(mesh: Mesh, u: Array, v: Array, material: Material) -> Array:
    """Return the derivative of `element_force` along `v` (E, 8, 3)."""
    return element_force(mesh, u + 1j * STEP * v, material).imag / STEP


def at_nodes(cells: NDArray[np.int32], values: Array, count: int) -> Array:
    """Sum values at the corners of cells (C, corners, ...) at `count` nodes."""
    total = np.zeros((count, *values.shape[2:]))
    np.add.at(total, cells, values)
    return total


@dataclass(frozen=True, slots=True)
class Rubbing:
    """State of friction at the previous step, and its limit."""

    coefficient: float
    stick: float
    tip_old: Array
    u_old: Array
    traction_old: Array
    limit: Array


def contact(
    mesh: Mesh,
    rule: tuple[Array, Array],
    indenter: Indenter,
    unit: float,
    tip: Array,
    penalty: float,
    multiplier: Array,
    u: Array,
    rubbing: Rubbing | None,
) -> dict[str, Array]:
    """Return contact by the host's signed distance and a return map: all values that the kernel
    writes, and the gap. `multiplier` (S, P) is the multiplier, a pressure without penetration.
    """
    shape, weight = rule
    corners = (mesh.nodes + u)[mesh.faces]
    place = np.einsum("pa,saj->spj", shape, corners) - tip
    gap, normal = indenter.distance(place * unit)
    gap = gap / unit
    pressure = np.maximum(multiplier - penalty * gap, 0.0)
    touched = pressure > 0
    area = weight * mesh.face_area[:, None]
    traction = np.zeros_like(place)
    energy = pressure**2 / penalty / 2
    slips = np.zeros_like(touched)
    if rubbing is not None:
        moved_by = np.einsum("pa,saj->spj", shape, (u - rubbing.u_old)[mesh.faces])
        moved_by = moved_by - (tip - rubbing.tip_old)
        spring = rubbing.stick * penalty
        trial = rubbing.traction_old - spring * moved_by
        trial = trial - normal * (normal * trial).sum(-1, keepdims=True)
        size = np.linalg.norm(trial, axis=-1)
        most = rubbing.coefficient * rubbing.limit
        slips = touched & (size > most)
        scale = np.where(slips, most / np.maximum(size, 1e-300), 1.0)
        traction = np.where(touched[..., None], trial * scale[..., None], 0.0)
        huber = np.where(slips, most * (size - most / 2), size**2 / 2) / spring
        energy = energy + np.where(touched, huber, 0.0)
    push = (normal * pressure[..., None] + traction) * area[..., None]
    return {
        "force": np.einsum("spj,pa->saj", push, shape),
        "touched": touched.sum(1),
        "pressure": pressure,
        "traction": traction,
        "energy": (energy * area).sum(1),
        "normal": np.where(touched[..., None], normal, 0.0),
        "slips": slips,
        "gap": gap,
    }


def scalars(values: Any, real: Any) -> Any:
    """Return an array of Warp scalars."""
    return wp.array(np.asarray(values, numpy_of(real)), dtype=real, device=CPU)


def vectors(values: Any, real: Any) -> Any:
    """Return an array of Warp 3-vectors along the last axis."""
    return wp.array(np.asarray(values, numpy_of(real)), dtype=vector_of(real), device=CPU)


def matrices(values: Any, real: Any) -> Any:
    """Return an array of Warp 3x3 matrices along the last two axes."""
    return wp.array(np.asarray(values, numpy_of(real)), dtype=matrix_of(real), device=CPU)


def integers(values: Any) -> Any:
    """Return an array of Warp integers."""
    return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=CPU)


def rows(active: Array) -> Any:
    """Return the launch rows (B,): numbers of the active environments, -1 for the others."""
    return integers(np.where(np.asarray(active) > 0, np.arange(len(active)), -1))


def zeros(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return an array of zeros of a Warp type."""
    return wp.zeros(shape, dtype=dtype, device=CPU)


def on_device(meshes: Sequence[Mesh], variant: Any, real: Any, points: int = 2) -> Any:
    """Return the struct of meshes for environments (B,), with `points`^2 points of contact."""
    return mesh_on(CPU, meshes, variant, face_rule(points), real)


def material_of(materials: list[Material], real: Any) -> Any:
    """Return the struct of the materials (B,)."""
    struct = material_struct(real)()
    for name in ("shear", "bulk", "factor", "bulk_factor", "stiffening"):
        setattr(struct, name, scalars([getattr(one, name) for one in materials], real))
    viscous = materials[0].history is not None
    history = [one.history for one in materials] if viscous else np.zeros((0, 0, 0, 3, 3))
    bulk_history = [one.bulk_history for one in materials] if viscous else np.zeros((0, 0))
    struct.history, struct.bulk_history = matrices(history, real), scalars(bulk_history, real)
    return struct


def contact_of(real: Any, **values: Any) -> Any:
    """Return a struct of contact with these values."""
    struct = contact_struct(real)()
    for name, value in values.items():
        setattr(struct, name, value)
    return struct


def relative(found: Array, expected: Array) -> float:
    """Return the largest difference over the largest expected value."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())
