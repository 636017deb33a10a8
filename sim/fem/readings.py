# mypy: ignore-errors
# Reads Warp arrays, typed at run time; mypy cannot follow them.
"""What the state last evaluated says of one environment: contact, traction, energy, weight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from sim.fem.assembly import Assembly


@dataclass(frozen=True, slots=True)
class ContactPoints:
    """Contact points of the T faces that touch, of one environment; in thicknesses and moduli."""

    pressure: np.ndarray
    """(T, P)."""
    penetration: np.ndarray
    """How deep they are inside the indenter (T, P); below 0 in a gap that the pressure bridges."""
    traction: np.ndarray
    """Shear traction on the body (T, P, 3)."""
    force: np.ndarray
    """Force on the body (T, P, 3)."""
    place: np.ndarray
    """Where they are (T, P, 3)."""
    area: np.ndarray
    """Untouched area of each (T, P)."""
    slip_excess: float
    """Largest |shear| - coefficient * pressure, over the largest pressure; NaN without friction."""


class Snapshot:
    """Arrays of the state last evaluated, on the host, of some of the environments.

    A GPU hands over each array that is asked for once, for all of them; a CPU copies nothing.

    Args:
        assembly: Whose state.
        environments: Of which environments.
        gather: Whether arrays are copied; on a GPU, when not said.
    """

    def __init__(
        self, assembly: Assembly, environments: Sequence[int], *, gather: bool | None = None
    ) -> None:
        self.assembly = assembly
        self._gathers = wp.get_device(assembly.device).is_cuda if gather is None else gather
        self._row = {env: row if self._gathers else env for row, env in enumerate(environments)}
        self._indices = None
        self._arrays: dict[int, np.ndarray] = {}

    def of(self, env: int, array) -> np.ndarray:
        """The part of environment `env` of an array whose first axis is the environment."""
        found = self._arrays.get(id(array))
        if found is None:
            found = self._arrays[id(array)] = self._fetched(array)
        return found[self._row[env]]

    def _fetched(self, array) -> np.ndarray:
        if not self._gathers:
            return array.numpy()
        if self._indices is None:
            self._indices = wp.array(list(self._row), dtype=wp.int32, device=array.device)
        return wp.indexedarray(array, [self._indices, *[None] * (array.ndim - 1)]).numpy()


def contact_points(held: Snapshot, env: int, u: np.ndarray) -> ContactPoints:
    """Pressure, force and place of the contact points of environment `env`, displaced by `u`."""
    assembly = held.assembly
    state, mesh = assembly.state, assembly.meshes[env]
    rows = np.flatnonzero(held.of(env, assembly.touched))
    pressure = held.of(env, state.pressure)[rows].astype(float)
    deep = (pressure - held.of(env, state.carried)[rows]) / assembly.numerics.penalty
    push = held.of(env, state.normal)[rows] * pressure[:, :, None]
    excess = np.nan
    traction = np.zeros_like(push)
    if "friction" in assembly.effects:
        traction = held.of(env, state.traction)[rows].astype(float)
        most = assembly.coefficients[env] * pressure
        size = np.linalg.norm(traction, axis=2)
        excess = float((size - most).max(initial=0.0) / pressure.max(initial=1e-30))
    faces = mesh.faces[rows]
    shape, rule = assembly.face_rule
    area = rule * mesh.face_area[rows, None]
    return ContactPoints(
        pressure=pressure,
        penetration=np.where(pressure > 0, deep, 0.0),
        traction=traction,
        force=(push + traction) * area[:, :, None],
        place=shape @ (mesh.nodes[faces] + u[faces]),
        area=area,
        slip_excess=excess,
    )


def surface_traction(held: Snapshot, env: int) -> np.ndarray:
    """Nodal force over nodal area on the top of one environment (X, Y, 3) [E]."""
    assembly = held.assembly
    mesh = assembly.meshes[env]
    nx, ny, nz = mesh.cells
    top = nx * ny
    rows = np.flatnonzero(held.of(env, assembly.touched)[:top])
    share = held.of(env, assembly.face_force)[rows].astype(float).reshape(-1, 3)
    columns = mesh.faces[:top] // (nz + 1)  # of nodes, which are numbered upwards
    count = (nx + 1) * (ny + 1)
    touched = columns[rows].ravel()
    force = [np.bincount(touched, share[:, axis], count) for axis in range(3)]
    area = np.bincount(columns.ravel(), np.repeat(mesh.face_area[:top], 4), count)
    nodal = np.stack(force, axis=-1) / area[:, None]
    return nodal.reshape(nx + 1, ny + 1, 3)


def stored_energy(held: Snapshot, env: int, points: ContactPoints, u: np.ndarray) -> float:
    """Energy in the material at rest modulus, contact springs and height [E T^3]."""
    assembly = held.assembly
    penalty = assembly.numerics.penalty
    square = (points.traction**2).sum(axis=2) / (assembly.numerics.stick * penalty)
    springs = ((points.penetration**2 * penalty + square) * points.area / 2).sum()
    if "gravity" in assembly.effects:
        weight = assembly.state.weight.numpy()[env].astype(float)
        springs -= (assembly.meshes[env].node_volume[:, None] * u * weight).sum()
    return float(held.of(env, assembly.element_energy).sum(dtype=float) + springs)


def body_force(held: Snapshot, env: int, u: np.ndarray) -> np.ndarray:
    """Weight less inertia of one environment (3,) [E T^2]."""
    assembly = held.assembly
    total = np.zeros(3)
    if "gravity" in assembly.effects:
        total += (
            assembly.state.weight.numpy()[env].astype(float)
            * assembly.meshes[env].node_volume.sum()
        )
    if "inertia" in assembly.effects:
        rate = assembly.state.rates[env]
        ahead = u - held.of(env, assembly.state.predicted)
        free = assembly.meshes[env].node_volume[:, None] * ahead
        total -= rate * free.sum(axis=0)
    return total
